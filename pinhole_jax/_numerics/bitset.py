"""Sets as bits, and where in a list something is: what a list of unknown length is worked off by.

Each is few kernels on purpose: what a program takes to compile is its kernels' number.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, UInt32

from .one_kernel import on_cpu, put
from .running import running_sum

#: Keys of 31 bits are put in order by so many at a time.
KEY_BITS, DIGIT = 31, 11


def count_upto(upto: Int[Array, "n"], value: Int[Array, "*K"]) -> Int[Array, "*K"]:
    """Return how many entries of an ascending list are at most each value."""
    n = upto.shape[0]
    bits = n.bit_length()

    def bisect(k, found):
        further = found + (jnp.int32(1) << (bits - 1 - k))
        low = upto[jnp.minimum(further, n) - 1] <= value
        return jnp.where((further <= n) & low, further, found)

    return jax.lax.fori_loop(0, bits, bisect, jnp.zeros(value.shape, jnp.int32))


def in_order(key: Int[Array, "P"]) -> Int[Array, "P"]:
    """Return the indices that put keys (at least 0) in order; of equal ones the first comes first.

    On a CPU digit by digit, in a twentieth of the time of a sort. Elsewhere, with 64 bits, key and
    index are sorted as one number, in a sixth of the time.
    """
    index = jnp.arange(key.shape[0], dtype=jnp.int32)
    numbers = jnp.zeros(1 << DIGIT, jnp.int32)
    room = index, jnp.zeros_like(index), numbers
    return on_cpu(_by_digits, key, *room, elsewhere=lambda key, *_: _sorted(key))


def _sorted(key: Int[Array, "P"]) -> Int[Array, "P"]:
    P = key.shape[0]
    index = jnp.arange(P, dtype=jnp.int32)
    wide = jax.dtypes.canonicalize_dtype(np.int64)
    if wide != np.int64:
        return jax.lax.sort((key, index), num_keys=1)[1]
    bits = max(P - 1, 1).bit_length()
    both = (key.astype(wide) << bits) | index.astype(wide)
    return (jax.lax.sort(both, is_stable=False) & ((1 << bits) - 1)).astype(jnp.int32)


def _by_digits(
    key: Int[Array, "P"], order: Int[Array, "P"], further: Int[Array, "P"], number: Int[Array, "n"]
) -> Int[Array, "P"]:
    """Return an `order` of keys, put in order by each of their digits, the lowest first."""
    P = key.shape[0]
    loop = lambda n, body, state: jax.lax.fori_loop(jnp.int32(0), jnp.int32(n), body, state)

    def one(state):
        shift, order, further, number = state
        digit = lambda i: (key[i] >> shift) & ((1 << DIGIT) - 1)
        number = loop(1 << DIGIT, lambda k, x: put(x, jnp.int32(0), k), number)
        number = loop(P, lambda i, x: put(x, x[digit(i)] + 1, digit(i)), number)

        def add(k, state):
            total, number = state
            total += number[k]
            return total, put(number, total, k)

        def place(k, state):
            number, further = state
            i = order[P - 1 - k]  # of equal digits the last is the last
            number = put(number, number[digit(i)] - 1, digit(i))
            return number, put(further, i, number[digit(i)])

        _, number = loop(1 << DIGIT, add, (jnp.int32(0), number))
        number, further = loop(P, place, (number, further))
        return shift + DIGIT, further, order, number

    most = loop(P, lambda i, most: jnp.maximum(most, key[i]), jnp.int32(0))
    goes_on = lambda s: (s[0] < KEY_BITS) & ((most >> jnp.minimum(s[0], KEY_BITS)) > 0)
    return jax.lax.while_loop(goes_on, one, (jnp.int32(0), order, further, number))[1]


class Selection(NamedTuple):
    """A set of edges as bits, 32 to a word, with the number of set bits before each word."""

    words: Array
    before: Int[Array, "words"]
    total: Int[Array, ""]


def select(mask: Bool[Array, "E"]) -> Selection:
    """Return the set of the mask's true entries, to be listed by `nth`.

    Counting bits in words is 10 times cheaper than `jnp.nonzero` over the edges of a large mesh.
    """
    return selection(words_of(mask))


def selection(words: UInt32[Array, "words"]) -> Selection:
    """Return the set of a word's bits."""
    if words.shape[0] < 2:  # (see `one_kernel`)
        return Selection(words, *_counted_beside(words))
    before = jnp.zeros(words.shape, jnp.int32)
    beside = lambda words, before: _counted_beside(words)
    return Selection(words, *on_cpu(_counted, words, before, elsewhere=beside))


def _counted(words: UInt32[Array, "words"], before: Int[Array, "words"]) -> tuple[Array, Array]:
    """Return how many bits are set before each word, and in all; word by word."""

    def one(k, state):
        before, total = state
        before = put(before, total, k)
        return before, total + jax.lax.population_count(words[k]).astype(jnp.int32)

    return jax.lax.fori_loop(0, words.shape[0], one, (before, jnp.int32(0)))


def _counted_beside(words: UInt32[Array, "words"]) -> tuple[Array, Array]:
    ones = jax.lax.population_count(words).astype(jnp.int32)
    upto = running_sum(ones)
    return upto - ones, upto[-1] if upto.shape[0] else jnp.int32(0)


def words_of(mask: Bool[Array, "*N"]) -> UInt32[Array, "*words"]:
    """Return booleans, 32 to a word; those of a last axis of 32 as its word."""
    mask = jnp.pad(mask, (0, -mask.shape[0] % 32)) if mask.ndim == 1 else mask
    bits = mask.reshape(-1, 32).astype(jnp.uint32)
    # One by one: the compiler makes two kernels of a sum. And as columns: a shape that changes at
    # each moves on by one of these each time that the compiler goes through the whole program.
    columns = (bits[:, k : k + 1] << k for k in range(32))
    return functools.reduce(jnp.bitwise_or, columns).reshape(-1)


def nth(selection: Selection, rank: Int[Array, "*K"]) -> Int[Array, "*K"]:
    """Return the indices of the set's entries number `rank`; an index within range past the end."""
    word = jnp.maximum(count_upto(selection.before, rank) - 1, 0)
    bits, rest = selection.words[word], (rank - selection.before[word]).astype(jnp.uint32)
    position = jnp.zeros_like(bits)
    for width in (16, 8, 4, 2, 1):  # binary search for the bit that `rest` set bits precede
        half = (bits >> position) & jnp.uint32((1 << width) - 1)
        ones = jax.lax.population_count(half)
        upper = rest >= ones
        rest = jnp.where(upper, rest - ones, rest)
        position = jnp.where(upper, position + jnp.uint32(width), position)
    return word * 32 + position.astype(jnp.int32)


def following(selection: Selection, index: Int[Array, ""]) -> Int[Array, ""]:
    """Return the set's next entry after an index (-1: its first), found word by word; what is past
    the last word if there is none."""
    last = jnp.int32(selection.words.shape[0] - 1)
    begin = index + 1
    word = jnp.minimum(begin >> 5, last)
    bits = selection.words[word] & (~jnp.uint32(0) << (begin & 31).astype(jnp.uint32))
    further = lambda s: (s[1] == 0) & (s[0] < last)
    word, bits = jax.lax.while_loop(
        further, lambda s: (s[0] + 1, selection.words[s[0] + 1]), (word, bits)
    )
    lowest = bits & (~bits + 1)
    return word * 32 + jax.lax.population_count(lowest - 1).astype(jnp.int32)


def rank_in(selection: Selection, index: Int[Array, "*K"]) -> Int[Array, "*K"]:
    """Return which number each index has in the set, -1 if it is not in it."""
    return jnp.where(bit(selection.words, index), count_below(selection, index), -1)


def count_below(selection: Selection, index: Int[Array, "*K"]) -> Int[Array, "*K"]:
    """Return how many of the set are smaller than each index."""
    word, place = index >> 5, (index & 31).astype(jnp.uint32)
    bits = selection.words[word] & ((jnp.uint32(1) << place) - 1)
    return selection.before[word] + jax.lax.population_count(bits).astype(jnp.int32)


def bit(words: UInt32[Array, "words"], index: Int[Array, "*K"]) -> Bool[Array, "*K"]:
    """Return whether each index is in the set of the words' bits."""
    return (words[index >> 5] >> (index & 31).astype(jnp.uint32)) & 1 > 0


def any_bit(
    words: UInt32[Array, "words"],
    begin: Int[Array, ""],
    first: Int[Array, ""],
    last: Int[Array, ""],
) -> Bool[Array, ""]:
    """Return whether some words, from one on, have bits between two (both counted), or these are
    in more than two words."""
    word = lambda k: words[jnp.clip(begin + (k >> 5), 0, len(words) - 1)]
    ones = jnp.uint32(0xFFFFFFFF)
    after = word(first) & (ones << (first & 31).astype(jnp.uint32))
    upto = word(last) & (ones >> (31 - (last & 31)).astype(jnp.uint32))
    same = (first >> 5) == (last >> 5)
    found = jnp.where(same, after & upto, after | upto)
    return ((last >> 5) - (first >> 5) > 1) | (found != 0)
