"""A scene: the subject, the room, the walk and the cameras of a phantom scan, in one strict tree.

Scenes are TOML files (`recipes/scenes/`). Units stand in the key names; an unknown key is an error that names the
nearest known one. pydantic checks at this border; inside, the tree is plain frozen dataclasses.
"""

from __future__ import annotations

import dataclasses
import difflib
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, get_args, get_type_hints

import tomli_w
from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from ..errors import RecipeError
from ..files.shipped import recipes_dir

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=0)]
Point = tuple[float, float, float]

DepthPreset = Literal["kinect-v1", "kinect-v2", "azure-kinect", "realsense-d435"]
StandingPreset = Literal["still", "quiet", "tired", "restless", "child", "breath-held"]
ThermalPreset = Literal["lwir-640", "lwir-320", "lepton-3.5", "p3"]


class _Strict:
    """Unknown keys and numbers that are not finite are errors."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid", allow_inf_nan=False)


@dataclass(frozen=True)
class ShapeConfig(_Strict):
    """The subject's surface. World frame: z up, floor at z = 0, the subject faces -y, its axis at x = y = 0."""

    kind: Literal["cylinder", "sphere", "bowl", "torso", "body", "head", "hand"] = "body"
    diameter_m: Positive = 0.165  # cylinder, sphere, bowl
    length_m: Positive = 0.5  # cylinder: its height
    base_m: NotNegative = 0.0  # height of the subject's lowest point above the floor
    opening: Annotated[float, Field(gt=0, lt=1)] = 0.5  # bowl: share of the sphere's area cut away; inside, F = 1 - it
    edge_mm: Positive = 6.0  # cylinder, sphere, bowl, torso: longest edge of a triangle
    subdivisions: Annotated[int, Field(ge=0, le=3)] = 1  # body, head, hand: each quarters the triangles (14, 7, 3.5 mm)
    height_scale: Positive = 1.0  # all body shapes
    girth_scale: Positive = 1.0  # horizontal, on top of height_scale
    belly_m: float = 0.0  # bulge of the abdomen
    arms_deg: Annotated[float, Field(ge=-45, le=80)] = 0.0  # from the A-pose: + lifts the arms, - brings them down
    arms_forward_deg: Annotated[float, Field(ge=-60, le=60)] = 0.0
    elbows_deg: Annotated[float, Field(ge=-45, le=60)] = 0.0  # + bends, from the A-pose's relaxed elbow
    legs_deg: Annotated[float, Field(ge=-6, le=20)] = 0.0  # + spreads the legs


@dataclass(frozen=True)
class SkinConfig(_Strict):
    """True temperature of the surface. All zero amplitudes: isothermal."""

    mean_degC: float = 33.0
    smooth_K: NotNegative = 0.0  # standard deviation of the large pattern
    smooth_m: Positive = 0.25  # its length
    spots: Count = 0  # Gaussian hot (and every third, cold) spots
    spot_K: NotNegative = 1.5
    spot_m: Positive = 0.02  # their standard deviation
    veins_K: NotNegative = 0.0  # warm lines
    veins_m: Positive = 0.12  # mesh size of their net
    vein_width_m: Positive = 0.004
    extremities_K: NotNegative = 0.0  # how much colder hands and feet are than the trunk (body shapes)


@dataclass(frozen=True)
class MaterialConfig(_Strict):
    """ε(θ): Fresnel of a smooth surface with index n + ik, or the same ε at every angle."""

    model: Literal["fresnel", "diffuse"] = "fresnel"
    n: Annotated[float, Field(gt=1)] = 1.33
    k: NotNegative = 0.0
    epsilon: Share = 0.95  # diffuse


@dataclass(frozen=True)
class PatchConfig(_Strict):
    """A region of other material and temperature: hair, cloth, tape. All surface inside the sphere belongs to it."""

    name: str
    center_m: Point
    radius_m: Positive
    material: MaterialConfig = MaterialConfig("diffuse")
    temperature_shift_K: float = 0.0
    albedo: Share = 0.15  # how bright the colour camera sees it


@dataclass(frozen=True)
class ThingConfig(_Strict):
    """A window, radiator or lamp: an upright rectangle that faces the subject, black, before the wall."""

    center_m: Point
    width_m: Positive
    height_m: Positive
    degC: float


@dataclass(frozen=True)
class OperatorConfig(_Strict):
    """Who holds the camera, in clothes, on the floor behind it: never in the picture, but reflected by the skin."""

    degC: float = 29.0
    height_m: Positive = 1.7


@dataclass(frozen=True)
class RoomConfig(_Strict):
    """What surrounds the subject, and the air between."""

    reflected_degC: float = 23.0
    reflected_error_K: float = 0.0  # written minus true
    background_degC: float | None = None  # what the thermal camera sees past the subject; None = the room as it is
    side_K: float = 0.0  # one wall is this much warmer than the mean, the opposite one colder
    side_deg: float = 90.0  # where the warm wall is; 0 = in front of the subject, counted as the walk's start_deg
    floor_to_ceiling_K: float = 0.0  # how much warmer the ceiling is than the floor
    span_m: Positive = 3.0  # radius of the room whose walls are uneven
    ceiling_m: Positive = 2.6  # its height
    things: tuple[ThingConfig, ...] = ()
    operator: OperatorConfig | None = None
    air_degC: float = 23.0
    relative_humidity_pct: Annotated[float, Field(ge=0, le=100)] = 40.0
    transmission_per_m: Annotated[float, Field(gt=0, le=1)] = 1.0
    floor: bool = False
    floor_degC: float = 22.0
    floor_radius_m: Positive = 2.5
    wall_radius_m: Positive | None = None  # a round wall that depth cameras see; None = open space
    reflections: Annotated[int, Field(ge=0, le=20)] = 3  # how often radiation is followed between parts of the body
    rays: Annotated[int, Field(ge=8, le=4096)] = 64  # per vertex over its hemisphere


@dataclass(frozen=True)
class PathConfig(_Strict):
    """The path of a hand-held camera round the subject."""

    turns: float = 1.0
    start_deg: float = 0.0  # 0 = in front of the subject
    radius_m: Positive = 1.1
    radius_wobble_m: NotNegative = 0.0
    height_from_m: float = 1.2
    height_to_m: float = 1.2
    height_wobble_m: NotNegative = 0.0
    wobbles_per_turn: NotNegative = 3.0
    look_from_m: float = 1.2  # height of the point on the axis that is looked at, at start and end
    look_to_m: float = 1.2
    roll_deg: float = 0.0  # 90 = portrait
    tremor_mm: NotNegative = 0.0  # of the hand, rms
    tremor_deg: NotNegative = 0.0


@dataclass(frozen=True)
class WalkConfig(PathConfig):
    """The path of the hand-held rig (or of the subject on a turntable, the rig at rest)."""

    subject_turns: bool = False
    depth_frames: Annotated[int, Field(ge=3)] = 180
    depth_hz: Positive = 15.0
    poses: Literal["given", "withheld"] = "given"


@dataclass(frozen=True)
class ApartConfig(PathConfig):
    """A thermal camera that is not on the rig: held by itself on a path of its own, or (turns = 0) on a stand."""

    frames: Annotated[int, Field(ge=1)] = 60
    hz: Positive = 5.0
    start_s: float = 0.0  # of its recording after depth's; may be negative, or hours


@dataclass(frozen=True)
class DepthConfig(_Strict):
    """The depth camera. `scale` shrinks the image (same field of view): small scans for tests."""

    preset: DepthPreset = "kinect-v1"
    scale: Annotated[float, Field(gt=0.05, le=1)] = 1.0
    noise: bool = True


@dataclass(frozen=True)
class DriftConfig(_Strict):
    """One offset per thermal frame: a jump at every shutter event, a ramp since the last, and a slow wander."""

    level_K: NotNegative = 0.0  # standard deviation of the level after a shutter event
    ramp_K_per_min: NotNegative = 0.0
    wander_K: NotNegative = 0.0
    shutter_every_s: Positive | None = None  # None = no shutter; the nearest frame is flagged and shows the shutter


@dataclass(frozen=True)
class BlackbodyConfig(_Strict):
    """A reference source held in front of the thermal camera, at a fixed place of the image."""

    degC: float = 35.0
    emissivity: Share = 0.98
    uncertainty_K: NotNegative = 0.03
    center: tuple[Share, Share] = (0.92, 0.915)  # of image width, height
    size: Annotated[float, Field(gt=0.02, lt=0.5)] = 0.083  # polygon's edge as share of the image height
    frames: tuple[Count, ...] = (0,)  # `index` of thermal frames; negative is not allowed


@dataclass(frozen=True)
class ScatterConfig(_Strict):
    """Light that the lens spreads widely: a share of it, under a kernel of this width."""

    share: Share
    width: Annotated[float, Field(gt=0, le=1)] = 0.1  # of the image's width: sigma, decay, core or radius of the kernel
    kernel: Literal["gaussian", "exponential", "tail", "disc"] = "gaussian"  # tail: (1 + r²/w²)^-1.5


@dataclass(frozen=True)
class ThermalConfig(_Strict):
    """The thermal camera; None = the preset's value."""

    preset: ThermalPreset = "lwir-640"
    scale: Annotated[float, Field(gt=0.05, le=1)] = 1.0
    every: Annotated[int, Field(ge=1)] = 3  # one thermal frame for so many depth frames
    phase_s: NotNegative = 0.0  # exposure of the first frame after the first depth frame
    netd_K: NotNegative | None = None
    psf_sigma_px: NotNegative | None = None
    supersample: Annotated[int, Field(ge=1, le=6)] = 2
    scatter: tuple[ScatterConfig, ...] = ()  # beside the point spread
    vignetting_K: float = 0.0  # what an image corner shows too little
    drift: DriftConfig = DriftConfig()
    blackbody: BlackbodyConfig | None = None
    apart: ApartConfig | None = None  # None = on the rig, `every` and `phase_s` count; else these two do not


@dataclass(frozen=True)
class ColorConfig(_Strict):
    """The colour camera."""

    every: Annotated[int, Field(ge=1)] = 1
    width_px: Annotated[int, Field(ge=32)] = 640
    height_px: Annotated[int, Field(ge=24)] = 480
    jpeg_quality: Annotated[int, Field(ge=10, le=100)] = 90


@dataclass(frozen=True)
class RigConfig(_Strict):
    """Written minus true: the errors of a rig's calibration, in a random direction."""

    rotation_error_deg: NotNegative = 0.0
    translation_error_mm: NotNegative = 0.0
    clock_error_s: float = 0.0  # a thermal frame was exposed this much later than written


@dataclass(frozen=True)
class MotionConfig(_Strict):
    """The living subject."""

    breathing_mm: NotNegative = 0.0  # how far the chest rises
    breaths_per_min: Positive = 14.0
    sway_mm: NotNegative = 0.0  # of the whole body, rms
    sway_deg: NotNegative = 0.0
    standing: StandingPreset = "still"  # bodies only: sway about the ankles, breath of chest and belly, arms, head
    standing_amount: NotNegative = 1.0  # times what the preset moves
    step_mm: NotNegative = 0.0  # bodies only: the left foot is set aside by so much in the middle of the recording

    @property
    def alive(self) -> bool:
        """The body changes its shape by more than breathing_mm."""
        return self.standing != "still" or self.step_mm > 0


@dataclass(frozen=True)
class SceneConfig(_Strict):
    """The whole tree."""

    name: str = "phantom"
    description: str = ""
    shape: ShapeConfig = ShapeConfig()
    skin: SkinConfig = SkinConfig()
    material: MaterialConfig = MaterialConfig()
    patches: tuple[PatchConfig, ...] = ()
    room: RoomConfig = RoomConfig()
    walk: WalkConfig = WalkConfig()
    depth: DepthConfig = DepthConfig()
    thermal: ThermalConfig = ThermalConfig()
    color: ColorConfig | None = None
    rig: RigConfig = RigConfig()
    motion: MotionConfig = field(default_factory=MotionConfig)

    def to_toml(self) -> str:
        """The resolved scene as TOML; keys whose value is None are left out (their default)."""
        return tomli_w.dumps(_without_none(dataclasses.asdict(self)))


def scene_from_mapping(tree: Mapping[str, Any], *, place: object = "scene") -> SceneConfig:
    """A scene from nested mappings. Raises RecipeError naming the key and its nearest match, or what was expected."""
    try:
        return TypeAdapter(SceneConfig).validate_python(dict(tree))
    except ValidationError as e:
        raise RecipeError(_first_fault(e), place=place) from None


def load_scene(source: str | Path) -> SceneConfig:
    """A scene from a TOML file, or the shipped scene of that name ("torso")."""
    path = Path(source)
    if not path.is_file():
        shipped = scenes_dir() / f"{source}.toml"
        if not shipped.is_file():
            match = difflib.get_close_matches(str(source), shipped_scenes(), n=1, cutoff=0.5)
            raise RecipeError(
                f"there is no scene '{source}'" + (f" (did you mean '{match[0]}'?)" if match else ""),
                hint=f"give a TOML file or one of {', '.join(shipped_scenes())}",
            )
        path = shipped
    try:
        tree = tomllib.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as e:  # a number of too many digits is a ValueError, too
        raise RecipeError(f"not a TOML file: {e}", place=path) from None
    return scene_from_mapping(tree, place=path)


def scenes_dir() -> Path:
    """Folder of the shipped scenes."""
    return recipes_dir() / "scenes"


def shipped_scenes() -> list[str]:
    """Names of the scenes that come with the package."""
    return sorted(p.stem for p in scenes_dir().glob("*.toml"))


def _without_none(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _without_none(v) for k, v in value.items() if v is not None}
    return [_without_none(v) for v in value] if isinstance(value, list | tuple) else value


def _first_fault(error: ValidationError) -> str:
    fault = error.errors()[0]
    loc = [str(p) for p in fault["loc"]]
    if fault["type"] == "unexpected_keyword_argument":
        known = _keys_at(SceneConfig, loc[:-1])
        match = difflib.get_close_matches(loc[-1], known, n=1, cutoff=0.5)
        return f"unknown key '{'.'.join(loc)}'" + (f" (did you mean '{match[0]}'?)" if match else "")
    return f"key '{'.'.join(loc)}': {fault['msg'][0].lower()}{fault['msg'][1:]}, got {fault['input']!r}"


def _keys_at(cls: Any, path: list[str]) -> list[str]:
    """Field names of the dataclass at a dotted path of the tree (list indices are skipped)."""
    for part in path:
        hints = get_type_hints(cls)
        if part in hints:
            inner = [t for t in (hints[part], *get_args(hints[part])) if dataclasses.is_dataclass(t)]
            cls = inner[0] if inner else cls
    return [f.name for f in dataclasses.fields(cls)]
