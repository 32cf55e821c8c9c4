"""A camera that is estimated to have stood still, before things that did and things that did not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.scan_maker import camera, stream, tiny_scan

from thermofusion.errors import QualityError
from thermofusion.geometry.rigid import pose, se3_exp
from thermofusion.recipe import InputSection, SubjectSection, TrackingSection
from thermofusion.scans.common import as_thermal
from thermofusion.tracking.frames import TrackingFrames
from thermofusion.tracking.still import held_against_pictures
from thermofusion.types import Rig

DEPTH, DISC_M, BOX_M = camera(320, 240, 260.0), 1.0, 0.9
TURNS_DEG = (0, 90, 200)


def views(turns_deg, *, warm=True):
    """A scan of a disc that is seen from above, a box on it 0.2 m off its middle, at three turns."""
    rng, tiny = np.random.default_rng(2), tiny_scan()
    lens = tiny.thermal.camera.lens

    def box(cam, turn_deg):
        v, u = np.mgrid[: cam.height_px, : cam.width_px]
        x, y = (u - cam.K[0, 2]) / cam.K[0, 0] * BOX_M, (v - cam.K[1, 2]) / cam.K[1, 1] * BOX_M
        a = np.radians(turn_deg)
        return (np.abs(x - 0.2 * np.cos(a)) < 0.07) & (np.abs(y - 0.2 * np.sin(a)) < 0.07)

    depth = [np.where(box(DEPTH, a), BOX_M, DISC_M) + rng.normal(0, 0.003, DEPTH.shape) for a in turns_deg]
    thermal = [
        np.where(box(lens, a) & warm, 22400, 22000) + 100 * k + rng.normal(0, 20, lens.shape)
        for k, a in enumerate(turns_deg)
    ]
    times = np.arange(len(turns_deg)) / 2
    return replace(
        tiny,
        rig=Rig(DEPTH),
        trajectory=None,
        color=None,
        depth=stream([d.astype(np.float32) for d in depth], times),
        thermal=as_thermal(stream([t.astype(np.uint16) for t in thermal], times), tiny.thermal.camera),
    )


def judge(scan, T=None, *, alone=False):
    sections = {"input": InputSection(), "tracking": TrackingSection()}
    frames = TrackingFrames.of(scan, subject=SubjectSection(background="keep", floor="keep"), **sections)
    n = len(scan.depth)
    small = [se3_exp(np.array([0.01, 0, 0, 0, 0.002 * k, 0])) for k in range(n)]  # as an estimate wavers
    held_against_pictures(frames, np.array(small) if T is None else T, np.ones(n, bool), alone=alone)


def test_a_turned_thing_that_was_fused_in_place_is_refused():
    with pytest.raises(QualityError, match=r"stood still, but \d+% of what it sees has changed.*record the poses"):
        judge(views(TURNS_DEG))
    with pytest.raises(QualityError):
        judge(replace(views(TURNS_DEG), thermal=None))


def test_what_stands_still_or_is_walked_round_is_not():
    judge(views((0, 0, 0)))  # a tripod; the camera drifts by two of its noise
    judge(views((0, 0, 0), warm=False))  # a thermal picture of noise alone
    judge(views(TURNS_DEG, warm=False))  # the depth alone says so, the thermal pictures are all alike
    judge(views(TURNS_DEG), alone=True)  # parts of a subject may move
    turn = np.radians(8)
    R = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
    judge(views(TURNS_DEG), np.array([np.eye(4), np.eye(4), pose(R, np.zeros(3))]))  # a camera that moved
    judge(views((0,)))  # one view
