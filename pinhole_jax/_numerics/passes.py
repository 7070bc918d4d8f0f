"""XLA's passes that programs here are compiled without.

Plain data: the tests read this file before the package is imported.
"""

#: They take a twelfth of a compilation, and without optimisation half of it, and gain nothing: a
#: check of XLA's own work, and what tidies loops that need it not. None changes what is computed.
LEFT_OUT = (
    "hlo-verifier",
    "reshape-mover",
    "simplify-sorts",
    "simplify-while-loops",
    "while-loop-constant-sinking",
    "while-loop-invariant-code-motion",
)
