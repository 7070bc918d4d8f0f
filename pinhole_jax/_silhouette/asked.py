"""What is to be drawn of a film, and what its pixels are, by the sums over the pieces in them."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

from .._camera.film import FilmMap
from .marks import Marks, overlaps
from .parts import Part

#: Pixels in a word of bits.
WORD = 32
#: Corners of pixels are kept of so many words: of all they would be as much as a large film.
CORNERS = 1 << 12


class Asked(NamedTuple):
    """What is to be drawn: curves, on which there are `base` layers on the left; whether they may
    overlap (`resolves`); what derivatives need (`keep`); `winding` above this number, or None."""

    film: FilmMap
    parts: list[Part]
    base: Int[Array, ""]
    resolves: bool
    keep: bool
    deep: float | None


class Corners(NamedTuple):
    """Winding numbers at pixels' lower left corners, of words in which pixels overlap: `of_word`
    says in which row of 32 of a table they are; so many rows are `used`, if there is room."""

    of_word: Int[Array, "words"]
    table: Float[Array, "numbers"]
    used: Int[Array, ""]

    @staticmethod
    def empty(words: int, real: Any) -> "Corners":
        """Return room for some of so many words."""
        rows = min(words, CORNERS) + 1  # what is in no row is written past the last one
        return Corners(jnp.zeros(words, jnp.int32), jnp.zeros(rows * WORD, real), jnp.int32(0))

    @property
    def known(self) -> Bool[Array, ""]:
        """Return whether there was room."""
        return self.used * WORD < self.table.shape[0]

    def with_word(
        self, word: Int[Array, ""], corner: Float[Array, "32"], there: Bool[Array, ""]
    ) -> "Corners":
        """Return these with a word's, if they are `there`."""
        put = lambda x, new, at: jax.lax.dynamic_update_slice(x, new, (at,))
        of_word = put(self.of_word, self.used[None], word)
        table = put(self.table, corner, self.used * WORD)
        return Corners(of_word, table, self.used + there.astype(jnp.int32))

    def at(self, index: Int[Array, ""]) -> Float[Array, ""]:
        """Return a bit's."""
        return self.table[self.of_word[index >> 5] * WORD + (index & 31)]


class Drawn(NamedTuple):
    """A film; None is what is not asked for.

    - `image`: the coverage, 0 where contours overlap.
    - `alone`: which pixels one chain of contour crosses, or none (both from the top row down).
    - `overlapping`: which must be resolved, as bits; each row has whole words, from the bottom up.
    - `layers`: of each word, the sum of the layers of the pieces in these.
    - `corners`: the winding numbers at these pixels' corners.
    - `winding`: the sum of these pixels' winding numbers (each the mean), less `deep` each.
    """

    image: Float[Array, "H W"]
    alone: Bool[Array, "H W"] | None
    overlapping: UInt32[Array, "H words"] | None
    layers: Float[Array, "H words"] | None
    corners: Corners | None
    winding: Float[Array, ""] | None


class Sums(NamedTuple):
    """Of pixels: by how much the winding number's mean grows from pixel to pixel in a row, and if
    contours may overlap `marks`, and sums of `winding_jumps` (left of the pixel) and `drops`."""

    deltas: Float[Array, "*N"]
    marks: Marks | None
    jumps: Float[Array, "*N"] | None
    drops: Float[Array, "*N"] | None

    @staticmethod
    def of(resolves: bool, number: int, real: Any) -> "Sums":
        """Return the sums of so many pixels without pieces, in a float type."""
        zeros = jnp.zeros(number, real)
        if not resolves:
            return Sums(zeros, None, None, None)
        return Sums(zeros, Marks(zeros, zeros.astype(jnp.int32)), zeros, zeros)


class Pixels(NamedTuple):
    """What is made of pixels' sums: see `Drawn`."""

    image: Float[Array, "*N"]
    alone: Bool[Array, "*N"]
    overlapping: Bool[Array, "*N"]
    winding: Float[Array, "*N"]


def judged(
    winding: Float[Array, "*N"], corner: Float[Array, "*N"], sums: Sums, keep: bool
) -> Pixels:
    """Return what pixels are, by their winding numbers: the mean, and at the lower left corner."""
    tie = 64 * jnp.finfo(winding.dtype).eps
    overlapping = covered = jnp.zeros(winding.shape, bool)
    if sums.marks is not None and sums.drops is not None:
        layers = sums.marks.layers
        # Where no curve is, the number is known exactly; sums of areas err with the layers.
        winding = jnp.where(layers == 0, corner, winding)
        overlapping = overlaps(sums.marks, winding)
        if keep:
            # A contour along the pixel's side, of whose layers the mean does not tell which it
            # bounds.
            overlapping |= (layers > 0) & (jnp.abs(winding - 1) < tie)
        covered = corner - sums.drops > 0.5
        overlapping &= ~covered
    image = jnp.where(covered, 1, jnp.where(overlapping, 0, jnp.clip(winding, 0, 1)))
    return Pixels(image, ~overlapping & ~covered & (winding < 1 + tie), overlapping, winding)


def words_in_row(W: int) -> int:
    """Return how many words of bits a row of the film has."""
    return -(-W // WORD)


def in_words(x: Array) -> Array:
    """Return rows of pixels (H, W) as rows of words (H words, `WORD`), filled up with 0."""
    return jnp.pad(x, ((0, 0), (0, -x.shape[1] % WORD))).reshape(-1, WORD)
