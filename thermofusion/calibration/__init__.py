"""System calibration: boards, three cameras on one rig, the radiometric curve, the clocks (paper section 2.3)."""
