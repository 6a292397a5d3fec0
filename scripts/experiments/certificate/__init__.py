"""Certificates of set-point control (section II-B of the paper): sublevel sets of V_L and bounds on dh/dq."""
