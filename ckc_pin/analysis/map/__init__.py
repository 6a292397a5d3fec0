"""The singularity map of any mechanism: the paper's Fig. 2, and the same in the Cartesian space of a point."""

from ckc_pin.analysis.map.compute import singularity_map
from ckc_pin.analysis.map.report import map_plain, map_table, sections_plain, sections_table
from ckc_pin.analysis.map.sections import workspace_sections

__all__ = ["map_plain", "map_table", "sections_plain", "sections_table", "singularity_map", "workspace_sections"]
