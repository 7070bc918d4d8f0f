"""How far are another renderer's derivative images from the set's?

    python experiments/reference/compare.py THEIRS [--set FOLDER]

THEIRS is a folder with a NAME.npz for each scene that was rendered, or one such file. In it are
images (H, W), row 0 on top, under the names of the set: `coverage`, `e_x`, `phi`, ...; what is not
there is not compared. Files of the set's own form will do. NumPy is all that this needs. The exit
status is 0 where all images agree.
"""

import argparse
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

SET = Path(__file__).parent / "set"
#: What is asked: correlation, and sums and sizes to one per cent.
CORRELATION, SHARE = 0.999, 0.01
#: What an image is off by, and where that comes from more often than not.
SUSPECTS = {
    -1.0: "the sign: an axis runs the other way, or the scene moved and not the camera",
    2.0: "a factor of two: a half counted twice, or a film that runs from -1 to 1",
    0.5: "a factor of one half: a difference over h divided by 2 h",
    np.pi / 180: "degrees for radians",
    180 / np.pi: "radians for degrees",
}


class Comparison(NamedTuple):
    """How an image compares with that of the set.

    - `correlation`: of the pixels (1 where both are null everywhere).
    - `factor`: by which the set's image has to be multiplied to come nearest to theirs.
    - `sums`: theirs and the set's. `apart`: their distance, in parts of the set's sum of sizes.
    - `worst`: (row, column) of the worst pixel; `theirs`, `ours` its values.
    """

    correlation: float
    factor: float
    sums: tuple[float, float]
    apart: float
    worst: tuple[int, int]
    theirs: float
    ours: float

    @property
    def agrees(self) -> bool:
        near = abs(self.factor - 1) <= SHARE and self.apart <= SHARE
        return self.correlation >= CORRELATION and near

    @property
    def suspicion(self) -> str:
        """Return the likely cause of a factor; empty if images agree or have little in common."""
        if self.correlation**2 < CORRELATION**2 or self.agrees:
            return ""
        near = [words for f, words in SUSPECTS.items() if abs(self.factor / f - 1) < 0.02]
        return near[0] if near else f"a factor of {self.factor:.3g}"


def compared(theirs: np.ndarray, ours: np.ndarray) -> Comparison:
    """Return a comparison of their image with ours.

    Raises ValueError where shapes differ, or where theirs is not finite.
    """
    theirs = np.asarray(theirs, float)
    if theirs.shape != ours.shape:
        raise ValueError(f"expected an image of shape {ours.shape}, got {theirs.shape}")
    if not np.all(np.isfinite(theirs)):
        raise ValueError("expected finite numbers, got NaN or infinity")
    size, square = np.sum(np.abs(ours)), np.sum(ours * ours)
    if square == 0:  # d moves nothing: neither may theirs
        still = not np.any(theirs)
        correlation, factor, apart = float(still), float(still), float(np.sum(np.abs(theirs)))
    else:
        spread = np.std(theirs) * np.std(ours)
        covariance = np.mean((theirs - theirs.mean()) * (ours - ours.mean()))
        correlation = float(covariance / spread) if spread else 0.0
        factor = float(np.sum(theirs * ours) / square)
        apart = float(np.abs(np.sum(theirs - ours)) / size)
    worst = np.unravel_index(np.argmax(np.abs(theirs - ours)), ours.shape)
    sums = float(np.sum(theirs)), float(np.sum(ours))
    place = int(worst[0]), int(worst[1])
    return Comparison(
        correlation, factor, sums, apart, place, float(theirs[worst]), float(ours[worst])
    )


def images_of(path: Path) -> dict[str, np.ndarray]:
    """Return the images of one of the set's files by name."""
    with np.load(path) as file:
        derivatives = dict(zip(file["parameters"].tolist(), file["derivatives"], strict=True))
        return {"coverage": file["coverage"], **derivatives}


def given_in(path: Path, names: list[str]) -> dict[str, np.ndarray]:
    """Return another renderer's images by name; the file may also have the set's own form."""
    with np.load(path) as file:
        if "derivatives" not in file:
            return {name: file[name] for name in names if name in file}
    return images_of(path)


def all_compared(theirs: Path, reference: Path) -> dict[tuple[str, str], Comparison]:
    """Return the comparisons by (scene, image), of all images that are in both folders."""
    paths = [theirs] if theirs.is_file() else sorted(theirs.glob("*.npz"))
    found = {}
    for path in paths:
        if not (reference / path.name).exists():
            print(f"{path.name}: there is no such scene in {reference}")
            continue
        ours = images_of(reference / path.name)
        for name, image in given_in(path, list(ours)).items():
            try:
                found[path.stem, name] = compared(image, ours[name])
            except ValueError as error:
                raise ValueError(f"{path.name}, `{name}`: {error}") from None
    return found


def table(found: dict[tuple[str, str], Comparison]) -> str:
    head = f"{'scene':<16}{'image':<19}{'correlation':>12}{'factor':>9}{'their sum':>13}"
    lines = [head + f"{'sum':>13}  worst pixel (row, column): theirs, the set's"]
    for (scene, name), c in found.items():
        numbers = f"{c.correlation:>12.6f}{c.factor:>9.4f}{c.sums[0]:>13.5g}{c.sums[1]:>13.5g}"
        worst = f"  {c.worst}: {c.theirs:.5g}, {c.ours:.5g}"
        verdict = "" if c.agrees else f"  DIFFERS {c.suspicion}".rstrip()
        lines.append(f"{scene:<16}{name:<19}{numbers}{worst}{verdict}")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("theirs", type=Path)
    parser.add_argument("--set", type=Path, default=SET, help="where the set is")
    given = parser.parse_args()
    if not given.theirs.exists():
        sys.exit(f"there is no {given.theirs}")
    found = all_compared(given.theirs, given.set)
    if not found:
        sys.exit(f"nothing to compare: no image in {given.theirs} has the name of one in the set")
    agree = sum(c.agrees for c in found.values())
    print(f"{agree} of {len(found)} images agree (correlation {CORRELATION}, sums to {SHARE:.0%})")
    print(table(found))
    sys.exit(agree < len(found))


if __name__ == "__main__":
    main()
