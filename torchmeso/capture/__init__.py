"""From a rig's frames to BTF and MDF: calibration, rectification, laser lines, space-time analysis, merge."""
