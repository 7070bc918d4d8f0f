"""Many fits: records in, rows out, on one machine or on many.

`fit_many` takes records (`FIELDS`) from anywhere; `read_dataset` makes them of data sets on disk.
`Results` are the rows (`COLUMNS`) that a run has written to a folder. `fit_one` fits one record,
for engines of your own.
"""

from .datasets import Dataset as Dataset, read_dataset as read_dataset
from .fit_many import Count as Count, fit_many as fit_many
from .fit_one import fit_one as fit_one
from .parts import Results as Results
from .records import FIELDS as FIELDS, shard_of as shard_of
from .rows import COLUMNS as COLUMNS, NO_FIT as NO_FIT
from .tables import fit_of as fit_of, merge as merge
