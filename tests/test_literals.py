"""Programs whose known numbers are written as the compiler wants them do what they did."""

import jax
import jax.numpy as jnp
import numpy as np

from pinhole_jax._numerics.bitset import following, select
from pinhole_jax._numerics.literals import tidied


def _steps(x, k):
    """Numbers converted, taken away, and added in turn, in a loop and out of it."""

    def body(i, total):
        near = jnp.where(total[i - 1] > 2, total[i - 1], 0)
        return total.at[i].set(jnp.clip(near - 1.5, -4, 9) + ((i - 1 + 3) % 3).astype(x.dtype))

    total = jax.lax.fori_loop(0, k, body, x)
    return jnp.where(total > 0, total, 1), (k - 2) - 3, jnp.uint32(0) - 1


def test_tidied_programs_return_the_same_bits():
    """Bit by bit, whole numbers that wrap around, too."""
    x = jnp.asarray(np.random.default_rng(0).normal(0, 4, 9))
    for found, true in zip(tidied(_steps)(x, jnp.int32(7)), _steps(x, jnp.int32(7)), strict=True):
        assert found.dtype == true.dtype
        np.testing.assert_array_equal(found, true)


def test_no_number_is_converted_or_taken_away():
    """In loops neither, which are programs of their own."""
    text = str(jax.make_jaxpr(tidied(_steps))(jnp.zeros(9), jnp.int32(7)))
    assert "_where" not in text
    assert "clip" not in text
    for line in text.splitlines():
        left = line.split(" = ")[-1].split()
        assert left[:1] != ["sub"], line
        assert not (line.count("convert_element_type") and line.split()[-1][0].isdigit()), line


def test_set_members_follow_one_another():
    """One after the other they are all that is in it."""
    mask = np.random.default_rng(1).random(300) < 0.03
    chosen, place, found = select(jnp.asarray(mask)), jnp.int32(-1), []
    for _ in range(mask.sum()):
        place = following(chosen, place)
        found.append(int(place))
    assert found == np.flatnonzero(mask).tolist()
    assert int(following(chosen, place)) >= 300
