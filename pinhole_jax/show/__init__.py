"""Pictures, tables and pages of cameras and fits; users call `pj.plot` and `pj.report`."""

from .. import Camera as Camera  # all public names: some of their modules import from this folder
