"""System calibration: boards, three cameras on one rig, the radiometric curve, the clocks (paper section 2.3).

`calibrate` goes from a folder of board pictures to a rig; the modules below it can be used by themselves.
"""

from __future__ import annotations

from .board.board import Board
from .board.print import board_pdf, board_svg
from .calibrate import Calibrated, calibrate
from .fit.rig import Calibration, calibrate_views, held_out_px, predict_px
from .report import report_html
from .rig_file import read_rig, rig_document, write_rig

__all__ = [
    "Board",
    "Calibrated",
    "Calibration",
    "board_pdf",
    "board_svg",
    "calibrate",
    "calibrate_views",
    "held_out_px",
    "predict_px",
    "read_rig",
    "report_html",
    "rig_document",
    "write_rig",
]
