"""The option with which a program is compiled by XLA's newer emitters, in spite of `conftest`."""

import os

#: Where a hit's distance is all that is asked for, its whole arithmetic is one fusion. XLA's older
#: emitters write it out anew for each time that it is read (an image of depths: 15 s of the
#: processor), the newer do not (3 s). Derivatives use all of a hit: there the older are quicker.
#: Empty where the newer are in use anyway.
FLAG = "xla_cpu_use_fusion_emitters"
NEWER = {FLAG: True} if FLAG in os.environ.get("XLA_FLAGS", "") else {}
