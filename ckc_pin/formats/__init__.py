"""Import from and export to the file formats of other programs.

`importing.read` reads a MuJoCo model (`mjcf`) or a URDF (`urdf`) into a `Draft`: a URDF tree, the loop closures beside
it, and notes on what was assumed or left out. `importing.write` writes a draft as a mechanism. `exporting.export`
converts a mechanism to another program's format.
"""
