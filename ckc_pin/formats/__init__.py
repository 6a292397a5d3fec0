"""Other people's files, in (`importing`) and out (`exporting`): a folder for each format.

`importing.read` makes a `Draft` of a file in `mjcf` or `urdf`: a URDF, what closes its loops, and what was guessed or
left out; `importing.write` writes it down as a mechanism. `exporting.export` makes another program's file of one.
"""
