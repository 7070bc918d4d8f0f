"""The command's arguments and its words on a terminal, with nothing that imports JAX."""
