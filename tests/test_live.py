"""The growing model: followed to its end, true to the truth, honest about what is lost and missing."""

from __future__ import annotations

import json
import time
import urllib.error
import urllib.request
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from thermofusion.files.shipped import data_dir
from thermofusion.files.tum import read_trajectory
from thermofusion.geometry.rigid import invert, rotation_angle_deg
from thermofusion.live.follow import Live, Sections, _step, follow
from thermofusion.live.model import SECTORS, Model
from thermofusion.live.page import Page
from thermofusion.live.walk import Walk
from thermofusion.recipe import load_recipe
from thermofusion.recording.record import Beside, Until, record
from thermofusion.recording.replay import open_replay, playing
from thermofusion.scans import open_scan
from thermofusion.scans.formats.recorded import Growing
from thermofusion.tracking.frames import PROBES, TrackingFrames
from thermofusion.tracking.odometry import MAX_GAP_FRAMES
from thermofusion.tracking.track import locate


@pytest.fixture(scope="module")
def recipe():
    whole = load_recipe("torso")
    return Sections(whole.input, whole.subject, whole.tracking)


@pytest.fixture(scope="module")
def taken(tmp_path_factory):
    """The demo scan as a recording, with a rig.json beside it."""
    out, demo = tmp_path_factory.mktemp("live") / "rec", data_dir() / "demo"
    begin_ns = time.monotonic_ns()
    openers = [
        partial(open_replay, demo, kinds, begin_ns, 1000.0, None) for kinds in (("depth", "color"), ("thermal",))
    ]
    record(openers, out, Until(), beside=Beside(rig=playing(demo).rig), own_process=False)
    return out


def test_a_recording_is_followed_to_its_end(taken, recipe):
    shown = []
    live = follow(taken, recipe, lambda live: shown.append((live.frames, len(live.points))))
    assert live.ended
    assert (live.frames, live.lost_frames, live.skipped) == (90, 0, 0)
    assert [n for n, _ in shown] == [*range(1, 91), 90]
    assert shown[-1][1] > 3000
    warm = live.points[np.isfinite(live.points[:, 3]), 3]
    assert len(warm) > 0.5 * len(live.points)
    assert 28 < np.median(warm) < 36  # apparent, of a torso


def test_poses_are_those_of_the_truth(taken, recipe):
    walk, scan = Walk(recipe.input, recipe.subject, recipe.tracking), open_scan(taken)
    walk.grown(scan)
    placed = [walk.take(i) for i in range(len(scan.depth))]
    truth = read_trajectory(data_dir() / "demo" / "truth" / "trajectory.txt").T_world_depth
    for k in (20, 45, 89):
        off = invert(invert(truth[0]) @ truth[k]) @ placed[k].T_world_depth
        assert np.linalg.norm(off[:3, 3]) < 0.03
        assert rotation_angle_deg(off) < 2


def test_a_jump_is_lost_at_once_and_found_again_where_it_was(taken, recipe):
    walk, scan = Walk(recipe.input, recipe.subject, recipe.tracking), open_scan(taken)
    walk.grown(scan)
    before = [walk.take(i).T_world_depth for i in range(8)]
    assert walk.take(45).T_world_depth is None  # the other side of the person
    assert walk.lost
    again = walk.take(6)
    assert not walk.lost
    assert np.linalg.norm((invert(before[6]) @ again.T_world_depth)[:3, 3]) < 0.01


def test_a_file_that_grows_byte_by_byte(taken, tmp_path):
    data, file = (taken / "recording.mcap").read_bytes(), tmp_path / "recording.mcap"
    growing, seen = Growing(tmp_path), 0
    assert not growing.look()
    rng = np.random.default_rng(2)
    for end in [*np.sort(rng.integers(100, len(data), 25)).tolist(), len(data)]:
        file.write_bytes(data[:end])
        growing.look()
        count = 0 if growing.scan is None else len(growing.scan.depth)
        assert count >= seen
        seen = count
    assert growing.complete
    whole = open_scan(taken).depth
    np.testing.assert_array_equal(growing.scan.depth.index, whole.index)
    np.testing.assert_array_equal(growing.scan.depth.load(88), whole.load(88))


class Ball:
    """A frame of a ball of radius 0.2 m that is seen from all the directions asked for."""

    def __init__(self, directions):
        self.map = self
        n = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        self.surface = np.concatenate([0.2 * n, n], axis=1).astype(np.float32)


def test_missing_sides_have_the_names_that_the_person_would_use():
    directions = np.random.default_rng(3).normal(size=(60_000, 3))
    facing, left = directions @ [0, 0, -1], directions @ [1, 0, 0]  # the person's left is at the camera's right
    model = Model()
    assert model.missing() == ("everything",)
    seen = directions[(facing > 0) | (left < 0)]  # never at the back of the left flank
    assert np.isnan(model.add(Ball(seen), 1.0, np.eye(4), np.full(len(seen), 33.0, np.float32)))
    assert model.missing() == ("back left",)
    rest = directions[(facing <= 0) & (left >= 0)]
    model.add(Ball(rest), 1.0, np.eye(4), np.full(len(rest), 33.0, np.float32))
    assert model.missing() == ()
    assert model.add(Ball(seen), 1.0, np.eye(4), np.full(len(seen), 33.8, np.float32)) == pytest.approx(0.8, abs=0.01)
    assert set(np.round(model.points(10_000)[:, 3], 1)) <= {33.0, np.float32(33.4), np.float32(33.2), np.float32(33.3)}
    assert len(SECTORS) == 8


def test_what_a_person_must_hear_comes_first():
    live = Live(lost=True, turn_deg_s=80, missing=("back",), drift_K=-0.9, shutter=True)
    assert [text.split(":")[0] for text in live.advice()] == [
        "TRACKING LOST",
        "slower",
        "the thermal camera corrects its shutter",
        "the thermal level drifts by -0.9 K",
        "missing",
    ]


def test_the_page_is_served_to_this_machine_alone():
    page = Page(["#000000"] * 256)
    try:
        assert page.address.startswith("http://127.0.0.1:")
        live = Live(frames=7, missing=("back",))
        live.points = np.array([[1, 2, 3, 33]], np.float32)
        page.show(live)
        with urllib.request.urlopen(page.address) as answer:
            assert answer.headers["Content-Security-Policy"].startswith("default-src 'none'")
            assert b"points.bin" in answer.read()
        with urllib.request.urlopen(page.address + "state.json") as answer:
            assert json.loads(answer.read())["advice"] == ["missing: back"]
        with urllib.request.urlopen(page.address + "points.bin") as answer:
            assert np.frombuffer(answer.read(), np.float32).tolist() == [1, 2, 3, 33]
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(page.address + "../etc/passwd")
        refused.value.close()
        assert refused.value.code == 404
        # a page from elsewhere, whose name was made to lead here
        elsewhere = urllib.request.Request(page.address + "points.bin", headers={"Host": "example.org"})
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(elsewhere)
        refused.value.close()
        assert refused.value.code == 404
    finally:
        page.close()


def test_a_burst_is_shown_as_far_as_there_is_time():
    assert [_step(waiting, 0.0) for waiting in (1, 6, 400)] == [1, 1, 1]
    assert _step(6, 0.05) == 1  # eight would be done before the next burst
    assert _step(6, 0.15) == 3  # two can be done
    assert _step(6, 2.0) == MAX_GAP_FRAMES  # no farther than tracking can jump
    assert _step(1, 2.0) == 1


def located(recording, recipe, ahead=None):
    scan = open_scan(recording)
    return locate(scan, input=recipe.input, subject=recipe.subject, tracking=recipe.tracking, ahead=ahead)


@pytest.mark.parametrize("left_out", [(), (40, 41)])
def test_the_final_poses_go_on_from_what_was_followed_and_are_the_same(taken, recipe, left_out, monkeypatch):
    walk, scan = Walk(recipe.input, recipe.subject, recipe.tracking), open_scan(taken)
    for count in (20, 60, len(scan.depth)):  # it grows
        walk.grown(first_frames(scan, count))
        for i in range({20: 0, 60: 20}.get(count, 60), count):
            if i not in left_out:
                walk.take(i)
    taken_first = len(walk.ahead.odometry.taken)
    assert taken_first == (40 if left_out else 90)  # a gap ends the order
    tracked_again = []
    load = TrackingFrames.load
    monkeypatch.setattr(TrackingFrames, "load", lambda own, i: tracked_again.append(i) or load(own, i))
    one = located(taken, recipe, walk.ahead)
    assert tracked_again[PROBES:] == list(range(taken_first, 90))
    other = located(taken, recipe)
    np.testing.assert_array_equal(one.trajectory.T_world_depth, other.trajectory.T_world_depth)
    np.testing.assert_array_equal(one.residual_mm, other.residual_mm)
    assert (one.loop_closures, one.converged, one.messages) == (other.loop_closures, other.converged, other.messages)


def test_what_was_followed_otherwise_is_not_gone_on_from(taken, recipe):
    walk, scan = Walk(recipe.input, recipe.subject, recipe.tracking), open_scan(taken)
    walk.grown(scan)
    for i in range(10):
        walk.take(i)
    ahead, indices = walk.ahead, np.arange(90)
    sections = {"subject": recipe.subject, "tracking": recipe.tracking}
    frames = TrackingFrames.of(scan, input=recipe.input, **sections)
    assert ahead.begun(frames, indices, **sections) is ahead.odometry
    assert ahead.begun(replace(frames, zoom=1.5), indices, **sections) is None  # the whole tells that it was near
    assert ahead.begun(frames, indices[1:], **sections) is None
    stricter = recipe.tracking.model_copy(update={"min_fitness": 0.9})
    assert ahead.begun(frames, indices, recipe.subject, stricter) is None
    assert ahead.depth_frames(scan, recipe.input) is not None
    assert ahead.depth_frames(scan, recipe.input.model_copy(update={"max_depth_m": 1.0})) is None
    assert ahead.depth_frames(replace(scan, depth_unit_m=0.002), recipe.input) is None


def first_frames(scan, count):
    """A scan of which so many depth frames are there."""
    s = scan.depth
    cut = replace(s, times_s=s.times_s[:count], places=s.places[:count], index=s.index[:count], usable=s.usable[:count])
    return replace(scan, depth=cut)
