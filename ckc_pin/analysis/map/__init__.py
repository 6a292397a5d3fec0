"""Singularity maps of a mechanism: the paper's Fig. 2, and the same in the Cartesian space of a point."""

from ckc_pin.analysis.map.compute import singularity_map
from ckc_pin.analysis.map.report import make_map_table, make_sections_table, sections_to_dict
from ckc_pin.analysis.map.sections import workspace_sections

__all__ = ["make_map_table", "make_sections_table", "sections_to_dict", "singularity_map", "workspace_sections"]
