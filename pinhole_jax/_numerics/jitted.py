"""Functions as programs."""

import equinox as eqx

jitted = eqx.filter_jit
