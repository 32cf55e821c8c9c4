"""Palettes, and pictures that a thermographer can measure in."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image
from support.result_maker import result, sphere

from thermofusion.errors import RecipeError
from thermofusion.export import axes_of, palettes
from thermofusion.report import lettering
from thermofusion.report.casts import MARGIN, VIEWS, cast_views
from thermofusion.report.lettering import Scale as ColorScale
from thermofusion.report.pictures import (
    SHADING,
    cast_mesh,
    difference_scale,
    paint,
    render_scalar,
    render_views,
    write_png,
    write_views,
)
from thermofusion.types import ThermalMesh
from thermofusion.version import __version__

INFERNO = ColorScale("inferno", 27.0, 33.0, "°C", "")


# ---------------------------------------------------------------- palettes


def lightness_of(srgb):
    """CIE L* (0..100) of sRGB bytes (..., 3), D65 white."""
    y = palettes.srgb_to_linear(srgb) @ np.array([0.2126, 0.7152, 0.0722], np.float32)
    return np.where(y > (6 / 29) ** 3, 116 * np.cbrt(y) - 16, y * (29 / 3) ** 3)


@pytest.mark.parametrize("name", ["inferno", "cividis"])
def test_published_palettes_are_met(name):
    """matplotlib ships the authors' tables (Open3D depends on it; the program does not import it)."""
    matplotlib = pytest.importorskip("matplotlib")
    published = matplotlib.colormaps[name](np.arange(256))[:, :3] * 255
    assert np.abs(palettes.table(name) - published).max() < 1.6  # within 1/255 of the rounded table


@pytest.mark.parametrize("name", ["inferno", "cividis", "grey", "iron"])
def test_lightness_rises(name):
    lightness = lightness_of(palettes.table(name))
    steps = np.diff(lightness[::8])
    assert (steps > 0).all()
    assert lightness[-1] - lightness[0] > 70
    if name != "iron":  # equal steps look equal
        assert steps.max() < 2.5 * steps.mean()


def test_lightness_is_the_standards():
    # CIE 1976: L* of sRGB mid grey 119 is 50.03; of pure red 53.24; of white 100.
    np.testing.assert_allclose(
        lightness_of(np.array([[119] * 3, [255, 0, 0], [255] * 3], np.uint8)), [50.03, 53.24, 100], atol=0.02
    )


def test_values_become_colours():
    table = palettes.table("iron")
    rgb = palettes.apply([29.0, 30.0, 33.0, 36.0, 40.0, np.nan], "iron", 30, 36, (1, 2, 3))
    np.testing.assert_array_equal(rgb, [table[0], table[0], table[128], table[255], table[255], (1, 2, 3)])
    assert not (table == palettes.unmeasured_rgb("iron")).all(axis=1).any()
    assert not (palettes.table("grey") == palettes.unmeasured_rgb("grey")).all(axis=1).any()
    for wrong in (("jet", 30, 36), ("iron", 36, 30), ("iron", np.nan, 36)):
        with pytest.raises(RecipeError):
            palettes.apply([33.0], *wrong)


def test_colour_range():
    values = np.concatenate([np.linspace(31.23, 35.11, 1000), [5.0, 90.0, np.nan]])
    assert palettes.color_range(values) == (31.0, 35.5)
    assert palettes.color_range(values, (30, 36)) == (30.0, 36.0)
    assert palettes.color_range(values - 33, symmetric=True, step=0.1) == pytest.approx((-2.1, 2.1))
    assert palettes.color_range(np.full(3, np.nan)) == palettes.DEFAULT_RANGE_DEGC
    assert palettes.color_range(np.full(3, 33.0)) == (32.5, 33.5)


# ---------------------------------------------------------------- views


def test_colours_are_the_surfaces_temperatures():
    """Temperature rises along z: each row of the front view must have its row's colour, to the palette's step."""
    mesh = result(sphere(120, 160), unmeasured_below_m=-9)
    cast = cast_mesh(mesh, height_px=556)[0]
    h, w = cast.shape
    panel = paint(cast, mesh.temperature_degC, INFERNO)
    columns = slice(w // 2 - 5, w // 2 + 6)
    height_m = (h / 2 - 0.5 - np.arange(h)) / cast.px_per_m
    inside = np.abs(height_m) < 0.097
    expected = palettes.apply(30 + 30 * height_m, "inferno", 27, 33)
    assert np.abs(panel[:, columns].astype(int) - expected[:, None])[inside].max() <= 3
    # The scale is that of the ruler: 0.2 m fill the height but for the margins.
    assert cast.px_per_m * 0.2 == pytest.approx(h * (1 - 2 * MARGIN), rel=1e-6)


def test_views_show_the_right_sides():
    """One warm spot per direction: up z, front -y; so somebody who faces the first camera has the left hand at +x."""
    spots = {"front": (0, -1, 0), "back": (0, 1, 0), "left": (1, 0, 0), "right": (-1, 0, 0)}
    mesh = result(sphere(60, 80), unmeasured_below_m=-9)
    unit = mesh.surface.normals
    for cast in cast_mesh(mesh, height_px=300):
        for name, direction in spots.items():
            warm = np.where(unit @ direction > 0.97, 33.0, 27.0).astype(np.float32)
            middle = paint(cast, warm, INFERNO)[cast.shape[0] // 2, cast.shape[1] // 2]
            assert (middle.sum() > 500) == (name == cast.name)
    shifted = np.where(unit @ [0.7, -0.7, 0] > 0.97, 33.0, 27.0)
    front, _, left, right = (paint(c, shifted, INFERNO).astype(int) for c in cast_mesh(mesh, height_px=300))
    yellow = [
        np.flatnonzero((p[p.shape[0] // 2, :, 0] > 200) & (p[p.shape[0] // 2, :, 2] < 200))
        for p in (front, left, right)
    ]
    assert (
        yellow[0].mean() > front.shape[1] * 0.6
    )  # the left hand's side is at the picture's right, seen from the front,
    assert yellow[1].mean() < left.shape[1] * 0.4  # and the chest at its left, seen from the left side
    assert len(yellow[2]) == 0


def test_the_world_may_lie_anyhow():
    """The same body in a world with z up and in one of a first camera (y down) gives the same pictures."""
    mesh = result(sphere(40, 60, (0.08, 0.05, 0.1)))
    R = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], float)  # z up, front -y  ->  y down, front -z
    unturned = {k: v for k, v in mesh.metadata.items() if k not in ("up", "front")}
    turned = replace(
        mesh,
        surface=replace(mesh.surface, vertices_m=(mesh.surface.vertices_m @ R.T).astype(np.float32)),
        metadata=unturned,
    )
    a, b = render_views(mesh, height_px=240), render_views(turned, height_px=240)
    bare = replace(mesh, metadata=unturned)
    c = render_views(bare, height_px=240, casts=cast_mesh(bare, height_px=240, up=[0, 0, 1], front=[0, -1, 0]))
    for name in (*VIEWS, "overview"):
        assert (np.abs(a[name].astype(int) - b[name]) > 8).mean() < 2e-3, name
        np.testing.assert_array_equal(a[name], c[name])
    np.testing.assert_allclose(axes_of(mesh.metadata) @ R.T, axes_of({}), atol=1e-12)


def test_unmeasured_inside_and_outline():
    mesh = result(sphere(60, 80), unmeasured_below_m=0.0)
    panel = paint(cast_mesh(mesh, height_px=400)[0], mesh.temperature_degC, INFERNO)
    h, w = panel.shape[:2]
    below = panel[h * 3 // 4, w // 2 - 40 : w // 2 + 40]
    assert (below == below[:, :1]).all()  # grey
    assert len(np.unique(below[:, 0])) == 2  # in stripes
    assert np.ptp(panel[h // 4, w // 2].astype(int)) > 50  # colour above
    # A hole in front shows the far wall from inside: dark stripes, never its temperature.
    front = mesh.surface.vertices_m[mesh.surface.triangles].mean(axis=1)[:, 1] < -0.08
    holed = replace(mesh, surface=replace(mesh.surface, triangles=mesh.surface.triangles[~front]))
    cast = cast_mesh(holed, height_px=400)[0]
    middle = paint(cast, np.full(len(mesh), 33.0), INFERNO)[h // 2 - 10 : h // 2 + 10, w // 2 - 10 : w // 2 + 10]
    assert set(np.unique(middle)) == {84, 112}
    # Outlines lie on the contour: every pixel inside keeps its colour.
    whole = result(sphere(60, 80), unmeasured_below_m=-9)
    cast = cast_mesh(whole, height_px=400)[0]
    filled = cast.per_pixel(np.ones(len(cast.pixel))) == 1
    panel = paint(cast, np.full(len(whole), 30.0), INFERNO)
    within = cv2.erode(filled.astype(np.uint8), np.ones((3, 3))) > 0
    assert (np.abs(panel[within].astype(int) - palettes.apply(30.0, "inferno", 27, 33)) <= 1).all()
    edge = cv2.dilate(filled.astype(np.uint8), np.ones((3, 3))) > 0
    assert panel[edge & ~filled].mean() < 160  # dark
    assert (panel[~cv2.dilate(filled.astype(np.uint8), np.ones((7, 7))).astype(bool)] == 255).all()


@pytest.mark.parametrize("name", palettes.PALETTES)
def test_shading_leaves_a_colour_its_place_on_the_bar(name):
    """A shaded colour's nearest one on the bar is its own, to a few steps, wherever skin faces the viewer by 45°."""
    mesh = result(sphere(60, 80), unmeasured_below_m=-9)
    cast, scale = cast_mesh(mesh, height_px=400)[0], replace(INFERNO, palette=name)
    flat, shaded = (paint(cast, mesh.temperature_degC, replace(scale, shading=s)).astype(int) for s in (0, SHADING))
    facing = cast.per_pixel(np.maximum(cast.facing, 0))
    table = palettes.table(name).astype(int)
    seen = facing > np.cos(np.radians(45))
    found, own = (np.abs(p[seen][:, None] - table).sum(axis=2).argmin(axis=1) for p in (shaded, flat))
    assert seen.sum() > 10_000
    assert np.abs(found - own).max() <= 10  # of 256
    assert np.abs(found - own).mean() < 4
    edge = (facing > 0.2) & (facing < 0.35)
    assert 0.85 < shaded[edge].sum() / flat[edge].sum() < 0.95  # and yet the shape shows


def test_the_bar_says_what_the_colours_mean():
    """The bar's colour at each tick is the palette's at that tick's value, and it stands in every page."""
    image = np.full((400, 200, 3), 255, np.uint8)
    outside = palettes.Beyond.of(np.array([31.0, 37.5]), 30, 36)
    lettering.color_bar(image, (20, 50, 20, 301), ColorScale("cividis", 30.0, 36.0, "°C", ""), 12, outside)
    for value in lettering.ticks(30.0, 36.0):
        row = round(50 + (36 - value) / 6 * 300)
        expected = palettes.apply(value, "cividis", 30, 36).astype(int)
        if value not in (30.0, 36.0):  # there the frame's line
            assert np.abs(image[row, 30].astype(int) - expected).max() <= 2
        assert (image[row, 41:45] == lettering.INK).all()
    assert image[:48, 30].min() < 255  # the point above
    assert (image[354:, 30] == 255).all()  # none below
    page = render_views(result(), height_px=300, palette="cividis")["front"]
    found = {tuple(rgb) for rgb in page[:, -60:].reshape(-1, 3).tolist()}
    assert len(found & {tuple(rgb) for rgb in palettes.table("cividis").tolist()}) > 100


@pytest.mark.parametrize(("lo", "hi"), [(26, 36), (31.5, 33), (-0.3, 0.3), (0, 1e-4), (0, 2500), (36.1, 36.2)])
def test_ticks_are_round(lo, hi):
    marks = lettering.ticks(lo, hi)
    labels = [lettering.tick_label(m, marks) for m in marks]
    assert lo - 1e-9 <= marks[0] <= marks[-1] <= hi + 1e-9
    assert 3 <= len(marks) <= 10
    assert [float(x) for x in labels] == pytest.approx(marks)
    if lo == 26:
        assert labels == ["26", "28", "30", "32", "34", "36"]


@pytest.mark.parametrize(
    "text", ["°", "Żółć", "Ελένη", "Анна", "أحمد", "שלום", "測試", "😀", "\x1b[31m\n", "\ud800", "x" * 9999]
)
def test_any_name_shows_as_letters_or_boxes(text):
    """Never nothing, never an exception, and cut off at the picture's border."""
    image = np.full((60, 400, 3), 255, np.uint8)
    lettering.write(image, text, 20, 40, 16)
    ink = np.nonzero(image[..., 0] < 128)
    assert len(ink[0]) > 10
    assert ink[1].min() >= 18
    lettering.write(image[:, :10].copy(), text, 3, -2, 16)


def test_letters_stand_where_they_are_put():
    image = np.full((60, 200, 3), 255, np.uint8)
    lettering.write(image, "H", 20, 40, 16)
    rows, columns = np.nonzero(image[..., 0] < 128)
    assert (rows.min(), rows.max()) == pytest.approx((24, 39), abs=1)  # a capital is 16 px high, on its base line
    assert columns.min() - 20 < 4
    right = np.full((60, 200, 3), 255, np.uint8)
    lettering.write(right, "H", 180, 40, 16, align="right")
    assert 176 <= np.nonzero(right[..., 0] < 128)[1].max() <= 180
    before = image.copy()
    lettering.write(image, "far outside", 900, -50, 16)
    lettering.write(image, "", 20, 30, 16)
    np.testing.assert_array_equal(image, before)


def test_the_font_comes_with_its_licence():
    folder = lettering.FONT.parent
    assert lettering.FONT.stat().st_size < 800_000
    assert "Bitstream Vera" in (folder / "LICENSE-DejaVuSans.txt").read_text()


def test_what_lies_outside_a_range_is_said():
    values = np.array([20.0, 29.0, 31.0, 32.0, np.nan])
    outside = palettes.Beyond.of(values, 30.0, 31.5)
    assert outside == palettes.Beyond(below=(0.5, 20.0), above=(0.25, 32.0))
    sentence = palettes.beyond_range(values, 30.0, 31.5)
    for words in ("30 to 31.5 °C", "50 % of the skin is colder (down to 20.0 °C)", "25 % of the skin is warmer"):
        assert words in sentence
    assert palettes.beyond_range(values, 19.0, 33.0) == ""
    assert palettes.beyond_range(np.full(4, np.nan), 30.0, 31.0) == ""
    assert [palettes.percent(x) for x in (1e-5, 0.004, 0.094, 0.5)] == ["under 0.1 %", "0.4 %", "9.4 %", "50 %"]
    # a page whose range leaves out skin differs above the panels, where its warning stands
    mesh = result()
    casts = cast_mesh(mesh, height_px=450)
    quiet, loud = (render_views(mesh, casts=casts, height_px=450, range_degC=x)["overview"] for x in ((0, 60), (0, 1)))
    alert = (loud[50:64, :300].astype(int) - [*lettering.ALERT]).__abs__().sum(axis=2) < 40
    assert alert.sum() > 50
    assert not ((quiet[50:64, :300].astype(int) - [*lettering.ALERT]).__abs__().sum(axis=2) < 40).any()


def headings(mesh, monkeypatch):
    """What is written on the overview, beside numbers of the bar."""
    said = []
    draw = lettering.write

    def heard(image, text, *rest, **how):
        said.append(text)
        draw(image, text, *rest, **how)

    monkeypatch.setattr(lettering, "write", heard)
    picture = render_views(mesh, height_px=300)["overview"]
    return " | ".join(said), picture


def test_titles_say_what_is_known(monkeypatch):
    known = {"scan": "Żółć 17", "room": "room 22.0 °C reflected", "up": "0 0 1", "front": "0 -1 0"}
    mesh = replace(result(), metadata={**known, "level_sigma_K_reference": 0.08, "level_sigma_K_reflected": 0.06})
    said, _ = headings(replace(mesh, anchored=True), monkeypatch)
    for words in ("Skin temperature", "±0.10 K", "Żółć 17", "room 22.0", "median", "R, L"):
        assert words in said
    assert "relative" not in said
    said, _ = headings(replace(mesh, anchored=False), monkeypatch)
    assert "level is unknown" in said
    assert "absolute" not in said
    said, _ = headings(replace(mesh, mode="apparent", anchored=False), monkeypatch)
    assert "Apparent temperature" in said
    assert "Skin temperature" not in said


def test_geometry_alone_has_no_temperatures_and_no_bar(monkeypatch):
    """A floor of 6 x 6 m: no title of temperatures, no colour bar, no picture metres wide."""
    wide = result(replace(sphere(20, 30, (3.0, 3.0, 0.1)), color_rgb=None), unmeasured_below_m=99)
    said, picture = headings(wide, monkeypatch)
    assert "emperature" not in said.replace("no temperature was measured", "")
    assert "600 cm wide" in said
    assert picture.shape[1] <= 1.1 * 4.2 * 300
    assert np.ptp(picture[..., :2].astype(int), axis=2).max() < 12  # shape in one light colour, no palette


def test_pictures_are_deterministic_and_written(tmp_path):
    mesh = result()
    paths = write_views(mesh, tmp_path / "views", height_px=300)
    assert {p.stem for p in paths} == {*VIEWS, "overview", "uncertainty", "residual"}
    pictures = render_views(mesh, height_px=300)
    for path in paths[:5]:
        np.testing.assert_array_equal(cv2.imread(str(path))[..., ::-1], pictures[path.stem])
    assert len({p.shape[0] for p in pictures.values()}) == 1
    with pytest.raises(ValueError, match="cannot be written"):
        write_png(tmp_path / "x.png", np.zeros((2, 2, 7), np.uint8))


@pytest.mark.parametrize("mode", ["nothing", "relative", "difference"])
def test_odd_results_are_drawn(mode):
    mesh = result()
    if mode == "nothing":
        empty = ThermalMesh.from_temperature(mesh.surface, np.full(len(mesh), np.nan))
        assert render_views(empty, height_px=200)["front"].shape[0] == 200
    elif mode == "relative":
        anchored = render_views(replace(mesh, anchored=True), height_px=300)["front"]
        assert not np.array_equal(render_views(mesh, height_px=300)["front"], anchored)
    else:
        values = np.where(mesh.measured, mesh.surface.vertices_m[:, 0], np.nan)
        scale = difference_scale(values, "Difference", "K")
        page = render_scalar(mesh, values, scale, height_px=300)["front"].astype(int)
        assert ((page[..., 0] - page[..., 2]) > 60).any()
        assert ((page[..., 2] - page[..., 0]) > 60).any()


def test_no_triangles_is_an_error():
    surface = replace(sphere(), triangles=np.zeros((0, 3), np.int32))
    with pytest.raises(ValueError, match="without triangles"):
        cast_views(surface, np.eye(3), 100)


def test_a_picture_keeps_its_texts_for_other_readers(tmp_path):
    image = np.zeros((3, 4, 3), np.uint8)
    path = write_png(tmp_path / "a.png", image, {"Scan": "Müller 71 µ", "Run": "ab12"})
    with Image.open(path) as picture:
        told = {"Software": f"thermofusion {__version__}", "Scan": "Müller 71 µ", "Run": "ab12"}
        assert picture.text == told  # type: ignore[attr-defined]
        assert picture.size == (4, 3)
    assert np.array_equal(cv2.imread(str(path)), image)
