"""Is anything worse than it was? The figures that changes are held to, and a gate.

    python experiments/frozen.py                             # measure, and show what differs
    python experiments/frozen.py --gate [--quick]            # ends with 1 where something is worse
    python experiments/frozen.py --gate --only speed --times 3   # another compiler: no cliffs
    python experiments/frozen.py --update --reason "..."     # a deliberate act: freezes anew

`--only GROUP,GROUP` takes some of the groups, `--quick` a smaller size with figures of its own:
some minutes, no times. `frozen.json` has each figure's value, unit, direction (whether lower or
higher is better, or neither), and by how much it may be worse. Times are ratios: over a plain
compiled loop in the same run, or over a fixed workload in NumPy. What is tried by the hundred goes
on where it was stopped, as long as no file of the package or of the experiments has changed.
"""

import argparse
import hashlib
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

HERE = Path(__file__).resolve().parent
KEPT = HERE / "frozen.json"
Known = dict[str, dict[str, Any]]


class Figure(NamedTuple):
    """A measured figure: the more of `amount` and `share` of the value is its tolerance."""

    name: str
    value: float
    unit: str
    direction: str = "lower"
    amount: float = 0.0
    share: float = 0.0


# Groups

#: Scenes of the reference set, the first for the quick size.
CLASSES = {
    "closed": ("torus", "bumpy", "bottle", "cube", "cut_off", "thin", "off_centre"),
    "open": ("bowl", "sheet", "ground", "triangle"),
    "soup": ("soup",),
    "spheres": ("spheres", "sphere", "sphere_and_mesh"),
    "lens": ("barrel", "pincushion", "fisheye"),
    "overlaps": ("two_bodies", "crossing"),
}


def errors(asked: Any) -> Iterator[Figure]:
    """Coverage against polygons in float64, derivatives against the set's, which polygons hold."""
    import jax
    import make
    from _oracle import coverage
    from _scenes import SET, views

    import pinhole_jax as pj

    known = views()
    single = lambda x: jax.tree.map(lambda y: y.astype("f4") if y.dtype.kind == "f" else y, x)
    for kind, names in CLASSES.items():
        worst: dict[str, float] = {"float64": 0.0, "float32": 0.0, "gradient": 0.0}
        for name in names[: 1 if asked.quick else None]:
            view = known[name]
            image, slopes = make.images(view)
            rough = pj.silhouette(single(make.camera_of(view)), single(make.scene_of(view)))
            with np.load(SET / f"{name}.npz") as file:
                right = file["derivatives"]
            polygons = coverage(view)
            most = np.abs(right).max(axis=(1, 2)) + 1e-3  # (some move nothing)
            off = {
                "float64": np.abs(image - polygons),
                "float32": np.abs(np.asarray(rough, float) - polygons),
                "gradient": np.abs(slopes - right) / most[:, None, None],
            }
            worst = {k: max(x, float(off[k].max())) for k, x in worst.items()}
        yield Figure(f"coverage, {kind}", worst["float64"], "px^2", amount=1e-12, share=0.5)
        yield Figure(f"coverage in float32, {kind}", worst["float32"], "px^2", amount=1e-6, share=1)
        yield Figure(f"gradient, {kind}", worst["gradient"], "of the largest", amount=1e-9, share=1)


def workload() -> float:
    """Return the seconds of the processor of a fixed workload in NumPy, on one core."""
    numbers, times = np.random.default_rng(0).random(2_000_000), []
    for _ in range(7):
        begin = time.process_time()
        np.cumsum(np.sort(numbers)[::7])
        times.append(time.process_time() - begin)
    return min(times)


def speed(asked: Any) -> Iterator[Figure]:
    """Masks, Jacobians and fits over a plain loop that does the least work."""
    import benchmark
    from _common import median_s

    import pinhole_jax as pj

    benchmark.on_one_core()
    for faces, px in ((1e4, 256), (3.28e5, 512)):
        row = benchmark.ratios(benchmark.sphere(faces), px, fits=True)
        for name in ("mask", "jacobian", "fit"):
            words = f"{name}, {faces:.3g} faces, {px} px"
            yield Figure(words, row[f"{name} ratio"], "times the loop", share=0.35)
            yield Figure(f"{words}, time", row[name] / 1e3 / workload(), "workloads", share=0.5)
    camera, scene = benchmark.general(256), benchmark.scan()
    seconds = median_s(lambda: pj.silhouette(camera, scene), time.process_time)
    yield Figure("mask of a scan, 82k faces, time", seconds / workload(), "workloads", share=0.5)


def first_calls(asked: Any) -> Iterator[Figure]:
    """What a new process waits for, with nothing kept."""
    import startup

    base = workload()
    for row in startup.first_calls(asked._replace(trials=3))["table"]:
        yield Figure(
            f"first call, {row['call']}", row["processor s"] / base, "workloads", share=0.25
        )


def memory(asked: Any) -> Iterator[Figure]:
    import benchmark

    for row in benchmark.memory(asked)["table"]:
        words = f"memory, {row['faces']:.0f} faces, {row['px']} px, {row['views']} views"
        yield Figure(words, row["times both"], "times scene and masks", share=0.15)


def near_symmetric(asked: Any) -> Iterator[Figure]:
    import honesty

    given = asked._replace(trials=10 if asked.quick else 200)
    found = honesty.exact("near-symmetric", honesty.SHAPES, given)
    yield Figure("near-symmetric, lies", found["lies"], "fits")
    yield Figure("near-symmetric, converged", found["converged"], "fits", "higher", 1, 0.05)
    yield Figure("near-symmetric, right", found["right"], "fits", "higher", 1, 0.03)


def table_of(name: str, every: dict) -> Iterator[Figure]:
    """Yield the figures of a summary by `honesty`."""
    for key, amount in (("> 5 deg", 1), ("> 5 deg, 4 sigma", 0), ("a better one was to be had", 1)):
        yield Figure(f"{name}, {key}", every[key], "fits", amount=amount)
    yield Figure(f"{name}, converged", every["converged"], "fits", "higher", 1, 0.05)
    yield Figure(f"{name}, error / sigma, 90 %", every["90 %"], "sigmas", share=0.15)
    yield Figure(f"{name}, error", every["... where determined"], "degrees", share=0.15)


def wrong_masks(asked: Any) -> Iterator[Figure]:
    import honesty

    given = asked._replace(trials=9 if asked.quick else 200)
    found = honesty.wrong("wrong-masks", honesty.DRAWN, given)
    yield from table_of("wrong masks", found["table"]["all"])


def occluders(asked: Any) -> Iterator[Figure]:
    import honesty

    given = asked._replace(trials=48)
    found = honesty.occluded("occluders", honesty.DRAWN, given)["table"]["all"]
    yield from table_of("occluders", found)
    yield Figure("occluders, noticed", found["told"], "fits", "higher", 2)


def intervals(asked: Any) -> Iterator[Figure]:
    import intervals as script

    given = asked._replace(trials=12 if asked.quick else 96, only=("bumpy", "bracket"))
    held = script.one_view(given)["table"]["wavering"]
    yield Figure("95 % intervals that hold", held["hold"], "share", "equal", 0.03)
    yield Figure("intervals, error / sigma", held["error / sigma"], "sigmas", "equal", share=0.2)


def real(asked: Any) -> Iterator[Figure]:
    import real as script

    rows = script.single(asked)["table"]
    sure = [row for row in rows if row["status"] == "converged"]
    for row in rows:
        yield Figure(f"real, {row['']}", row["degrees"], "degrees", amount=0.02, share=0.25)
    if rows:
        wrong = sum(row["most sigmas"] > 4 and row["degrees"] > 0.5 for row in sure)
        yield Figure("real, converged", len(sure), "fits", "higher")
        yield Figure("real, converged falsely", wrong, "fits")


def robots(asked: Any) -> Iterator[Figure]:
    import real as script

    for way, row in script.robots(asked)["table"].items():
        off = abs(row["baseline, mm"] - script.BASELINE)
        yield Figure(f"robot, {way}: baseline", off, "mm off", amount=0.5)
        turn = row["degrees from parallel"]
        yield Figure(f"robot, {way}: parallel", turn, "degrees", amount=0.03)
        yield Figure(f"robot, {way}: error / sigma", row["most sigmas"], "sigmas", amount=0.5)


Group = Callable[[Any], Iterator[Figure]]
TIMED: dict[str, Group] = {"speed": speed, "first-calls": first_calls, "memory": memory}
QUICK: dict[str, Group] = {
    "errors": errors,
    "near-symmetric": near_symmetric,
    "wrong-masks": wrong_masks,
    "intervals": intervals,
}
GROUPS = {**QUICK, "occluders": occluders, "real": real, "robots": robots, **TIMED}


# Measure


def digest() -> str:
    """Return a hash of this code: its files and the packages it runs on."""
    import jax

    found = hashlib.sha256(f"{jax.__version__} {np.__version__}".encode())
    for folder in (HERE, HERE.parent / "pinhole_jax"):
        for path in sorted(folder.rglob("*")):
            if path.suffix in (".py", ".cc", ".h", ".npz"):
                found.update(path.read_bytes())
    return found.hexdigest()[:12]


def measured(group: str, quick: bool, cache: Path) -> Known:
    """Return a group's figures by name, made in a process of its own."""
    size = "quick" if quick else "full"
    folder = cache / digest() / size
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{group}.json"
    if group in TIMED or not path.exists():
        words = [sys.executable, __file__, "--group", group, str(path), size]
        subprocess.run(words, check=True)
    return json.loads(path.read_text())


def child(group: str, path: Path, size: str) -> None:
    """Write a group's figures to a file."""
    import jax
    from _common import Options

    import pinhole_jax as pj

    sys.path.insert(0, str(HERE / "reference"))
    jax.config.update("jax_enable_x64", group not in TIMED)
    pj.cache()
    found = {}
    for figure in GROUPS[group](Options(path.parent, quick=size == "quick", resume=True)):
        row = figure._asdict()
        name, share, amount = (row.pop(key) for key in ("name", "share", "amount"))
        row["value"] = float(f"{figure.value:.6g}") if isfinite(figure.value) else None
        row["tolerance"] = float(f"{max(amount, share * abs(figure.value)):.3g}")
        row["how"] = f"python experiments/frozen.py --only {group}"
        found[name] = row
    path.write_text(json.dumps(found, indent=1) + "\n")


# Compare


def compared(known: Known, fresh: Known, times: float = 1.0) -> dict[str, str]:
    """Return a verdict for each figure: "worse" and "cannot compare" are those that the gate is
    for, "better" is for an update. As much as `times` the frozen value is not worse."""
    found = {}
    for name in dict.fromkeys([*known, *fresh]):
        if name not in known:
            found[name] = "not frozen"
            continue
        old, tolerance = known[name]["value"], known[name]["tolerance"]
        new = fresh.get(name, {}).get("value")
        if old is None or new is None:
            found[name] = "cannot compare"
            continue
        gain = {"lower": old - new, "higher": new - old, "equal": -abs(new - old)}
        better = gain[known[name]["direction"]]
        tolerance = max(tolerance, (times - 1) * abs(old))
        tolerance += 1e-9 * abs(old)  # both values are rounded
        found[name] = "worse" if better < -tolerance else "better" if better > tolerance else "same"
    return found


def show(known: Known, fresh: Known, verdicts: dict[str, str]) -> None:
    """Print what is not the same, the worse first."""
    for name in sorted(verdicts, key=lambda name: verdicts[name] != "worse"):
        if verdicts[name] != "same":
            row = known.get(name) or fresh[name]
            values = [of.get(name, {}).get("value", "–") for of in (known, fresh)]
            allowed = f"{row['direction']}, +-{row['tolerance']:g} {row['unit']}"
            print(f"{verdicts[name]:15} {name}: {values[0]} -> {values[1]} ({allowed})")


def gate(kept: dict, size: str, fresh: dict[str, Known], times: float = 1.0) -> int:
    """Return 1 where a figure of the groups is worse, or where nothing can be said of it."""
    if size not in kept:
        print(f"cannot compare: nothing is frozen at the {size} size (--update --reason ...)")
        return 1
    bad = 0
    for group, figures in fresh.items():
        known = kept[size].get(group, {})
        if not known:
            print(f"cannot compare: {group} is not frozen at the {size} size")
            bad += 1
        elif not figures:
            print(f"cannot compare: {group} was skipped, its data are not there")
        else:
            verdicts = compared(known, figures, times)
            show(known, figures, verdicts)
            bad += sum(x in ("worse", "cannot compare") for x in verdicts.values())
    print(f"{bad} figures are worse, or cannot be compared" if bad else "Nothing is worse.")
    return min(bad, 1)


def update(kept: dict, size: str, fresh: dict[str, Known], reason: str) -> None:
    """Write the figures of the groups that were measured, and why."""
    groups = {group: figures for group, figures in fresh.items() if figures}
    kept.setdefault("reasons", []).append({"groups": [*groups], "size": size, "reason": reason})
    kept.setdefault(size, {}).update(groups)
    KEPT.write_text(json.dumps(kept, indent=1) + "\n")


def main() -> int:
    if sys.argv[1:2] == ["--group"]:
        child(sys.argv[2], Path(sys.argv[3]), sys.argv[4])
        return 0
    words = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=words)
    parser.add_argument("--gate", action="store_true", help="end with 1 where something is worse")
    parser.add_argument("--update", action="store_true", help="write frozen.json")
    parser.add_argument("--reason", default="", help="why figures change, for --update")
    parser.add_argument("--quick", action="store_true", help="some minutes")
    parser.add_argument("--only", help=f"of {', '.join(GROUPS)}")
    parser.add_argument("--times", type=float, default=1.0, help="how much larger is not worse")
    parser.add_argument("--cache", type=Path, default=Path("out", "frozen"), help="trials so far")
    given = parser.parse_args()
    groups = given.only.split(",") if given.only else [*(QUICK if given.quick else GROUPS)]
    if unknown := {*groups} - {*GROUPS}:
        parser.error(f"`--only`: expected {', '.join(GROUPS)}, got {', '.join(unknown)}")
    if given.update and not given.reason.strip():
        parser.error("`--update`: expected `--reason` with it: why is it right that they change?")
    kept = json.loads(KEPT.read_text()) if KEPT.exists() else {}
    size = "quick" if given.quick else "full"
    fresh = {group: measured(group, given.quick, given.cache) for group in groups}
    worse = gate(kept, size, fresh, given.times)
    if given.update:
        update(kept, size, fresh, given.reason)
        print(f"Written: {KEPT.name}")
    return worse if given.gate else 0


if __name__ == "__main__":
    sys.exit(main())
