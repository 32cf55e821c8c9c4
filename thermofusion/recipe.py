"""The recipe: everything a person may choose about processing, in one strict tree.

Recipes are TOML files. Units stand in the key names. Unknown keys are errors that name the nearest match. Precedence:
the defaults here < the file < `--set section.key=value`. The resolved recipe is written beside every result.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

import tomli_w
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from .errors import RecipeError
from .files.shipped import recipes_dir
from .files.strict import first_fault, nearest, shortened


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=True)


class InputSection(_Section):
    """How streams are paired and which depth is believed."""

    pair_tolerance_ms: float = Field(
        40.0, ge=0.1, le=10_000, description="a colour frame farther in time from its depth frame is left out"
    )
    max_pose_gap_ms: float = Field(
        500.0, ge=0.1, le=60_000, description="a thermal frame in a longer gap of the trajectory is left out"
    )
    min_depth_m: float = Field(0.4, ge=0, le=10, description="nearer depth is dropped")
    max_depth_m: float = Field(3.0, ge=0.1, le=20, description="farther depth is dropped")
    max_grazing_deg: float = Field(80.0, ge=10, le=90, description="depth seen more obliquely is dropped")
    flying_pixel_mm: float = Field(
        25.0,
        ge=1,
        le=1000,
        description="a pixel that stands this far from its neighbours at 1 m is dropped (scales with range²)",
    )

    @model_validator(mode="after")
    def _range_is_open(self) -> InputSection:
        if not self.min_depth_m < self.max_depth_m:
            raise ValueError(f"min_depth_m ({self.min_depth_m:g} m) must be below max_depth_m ({self.max_depth_m:g} m)")
        return self


class SubjectSection(_Section):
    """What belongs to the subject and what is room."""

    background: Literal["keep", "remove"] = Field(
        "remove", description="remove what stands beyond the subject before tracking"
    )
    floor: Literal["auto", "keep", "remove"] = Field("auto", description="auto: removed where a floor plane is found")
    floor_clearance_mm: float = Field(
        12.0, ge=0, le=500, description="surface nearer than this to the floor plane goes with it"
    )
    motion: Literal["camera", "subject"] = Field(
        "camera", description="subject: the camera stands still and the subject turns"
    )
    keep_components: int = Field(
        1, ge=0, le=1000, description="largest connected pieces of surface kept; 0 = all above min_component_cm2"
    )
    min_component_cm2: float = Field(50.0, ge=0, le=100_000, description="smaller pieces of surface are dropped")


class TrackingSection(_Section):
    """Where the depth camera was. Recorded trajectories are used as they are unless `refine`."""

    source: Literal["auto", "recorded", "estimate"] = Field("auto", description="auto: recorded where there is one")
    refine: bool = Field(False, description="a recorded trajectory is only a start, refined like an estimated one")
    color: bool = Field(True, description="colour helps where a colour camera was recorded")
    fragment_frames: int = Field(8, ge=2, le=1000, description="consecutive frames fused before loop closure, at most")
    max_fragment_shift_deg: float = Field(45.0, gt=0, le=90, description="motion in the image that ends a fragment")
    loop_closure: bool = Field(True, description="places seen again tie the camera's path together")
    refine_to_model: bool = Field(True, description="a last alignment of every frame with the fused model")
    min_fitness: float = Field(0.5, gt=0, le=1, description="share of a frame's points that must find a partner")
    max_residual_mm: float = Field(
        8.0, ge=0.1, le=1000, description="median point-to-plane distance at 1 m above which a frame is lost"
    )


class SurfaceSection(_Section):
    """Depth frames into one surface (TSDF)."""

    voxel_mm: Literal["auto"] | Annotated[float, Field(ge=0.5, le=100)] = Field(
        "auto", description="edge of a voxel; auto: from depth noise and thermal footprint"
    )
    truncation_voxels: Literal["auto"] | Annotated[float, Field(ge=1, le=50)] = Field(
        "auto", description="TSDF truncation in voxels; auto: 3.5 times the depth noise, at least 2.5 voxels and 8 mm"
    )
    min_weight: float = Field(3.0, ge=0, le=10_000, description="surface seen by fewer depth frames is dropped")
    normal_window_mm: float = Field(
        25.0, ge=1, le=200, description="normals are averaged over this diameter (20-30 mm for Kinect)"
    )
    smooth_iterations: int = Field(0, ge=0, le=1000, description="Taubin smoothing steps of the mesh")
    max_memory_gib: float = Field(
        2.0, ge=1e-5, le=1024, description="bound on the voxel grid's memory; the voxel grows to meet it"
    )
    color: bool = Field(True, description="colour the surface from the colour camera")
    motion: bool = Field(True, description="solve how the subject moved (sway, breath, arms) and fuse it at rest")


class RigSection(_Section):
    """The thermal camera's place and clock."""

    align: bool = Field(True, description="refine the rig extrinsic and the thermal clock where the data support it")
    mount: Literal["auto", "rig", "free"] = Field(
        "auto",
        description="free: the thermal camera is not on the depth rig, each view is placed by outline and pattern; "
        "auto: as the scan says",
    )


class MappingSection(_Section):
    """Thermal views onto the surface."""

    silhouette_px: float = Field(
        3.0, ge=0, le=100, description="pixels nearer to a silhouette count only where nothing clearer saw the spot"
    )
    last_resort_silhouette_px: float = Field(2.0, ge=0, le=100, description="pixels nearer than this are never used")
    border_px: float = Field(8.0, ge=0, le=500, description="pixels nearer to the image border are rejected")
    max_angle_deg: float = Field(
        65.0, ge=5, le=89, description="more oblique views count only where nothing better saw the spot"
    )
    last_resort_angle_deg: float = Field(75.0, ge=5, le=89, description="beyond this a view is never used")
    visibility_tolerance_mm: float = Field(
        8.0, ge=0.1, le=200, description="how far behind the visible surface a vertex may lie and still count as seen"
    )
    view_motion: bool = Field(False, description="small rigid correction of each view (breathing, sway)")

    @model_validator(mode="after")
    def _last_resort_is_steeper(self) -> MappingSection:
        if self.last_resort_angle_deg < self.max_angle_deg:
            least = f"{self.max_angle_deg:g}°, the value of max_angle_deg"
            raise ValueError(f"last_resort_angle_deg must be at least {least}")
        return self


class EmissivitySection(_Section):
    """ε(θ) of the surface."""

    model: Literal["dielectric", "non-dielectric", "cosine", "water", "tabulated", "fitted", "blackbody"] = Field(
        "dielectric", description="how emissivity falls with the angle; skin is a dielectric"
    )
    n: float | None = Field(
        None,
        gt=1,
        le=20,
        description="refractive index; None = 1.33 (dielectric, non-dielectric) or 1.2233 (fitted: water)",
    )
    k: float | None = Field(
        None, ge=0, le=50, description="extinction coefficient; None = 0.25 (non-dielectric) or 0.1304 (fitted: water)"
    )
    epsilon0: float | None = Field(
        None, ge=0.01, le=1, description="emissivity straight on; scales the model's curve to it"
    )
    angles_deg: list[Annotated[float, Field(ge=0, le=90)]] = Field(
        default_factory=list, description="tabulated: angles, rising from 0"
    )
    values: list[Annotated[float, Field(ge=0, le=1)]] = Field(
        default_factory=list, description="tabulated: ε at those angles"
    )


class EarlierFieldSection(_Section):
    """What an earlier scan of a camera found of its field: the rms over the image of each pattern, and its sigma."""

    K: tuple[Annotated[float, Field(ge=-100, le=100)], ...] = Field(strict=False, min_length=14, max_length=14)
    sigma_K: tuple[Annotated[float, Field(gt=0, le=100)], ...] = Field(strict=False, min_length=14, max_length=14)
    width_px: int = Field(ge=1, le=100_000)
    height_px: int = Field(ge=1, le=100_000)
    age_days: float | None = None


class CrosscalSection(_Section):
    """What overlapping views are asked to settle."""

    offsets: bool = Field(True, description="one offset per thermal view (drift, shutter jumps)")
    vignetting: bool = Field(True, description="one low-order field over the image, common to all views")
    shape: bool = Field(True, description="the shape of ε(θ), where the overlap carries it")
    gain: bool = Field(False, description="one gain of the camera, where references carry it")
    surroundings: bool = Field(True, description="the body's own radiation, reflected in folds")
    max_vertices: int = Field(40_000, ge=1000, le=10_000_000, description="vertices the solver uses; all are mapped")
    field: EarlierFieldSection | None = Field(
        None,
        description="an earlier scan's field of the same camera, as `run --field RESULT` fills it in: `K`, `sigma_K` "
        "of its 14 patterns, `width_px` and `height_px` of the image, `age_days`",
    )


class TemperatureSection(_Section):
    """From signal to temperature."""

    method: Literal["joint", "corrected-cos", "cos-resolution", "mean", "nearest-view", "paper"] = Field(
        "joint", description="joint = cross-calibrated views; the others are for comparison"
    )
    output: Literal["absolute", "normal-equivalent", "apparent"] = Field(
        "absolute", description="what scalar_temperature holds"
    )
    weight: Literal["inverse-variance", "cos-resolution"] = Field(
        "inverse-variance", description="how views of one spot are averaged: by their errors, or by angle and distance"
    )
    reflected_degC: float | None = Field(None, ge=-100, le=500, description="overrides the scan's environment")
    air_degC: float | None = Field(None, ge=-100, le=200, description="overrides the scan's environment")
    transmission_per_m: float = Field(
        1.0, ge=0.01, le=1, description="of the air path; 1 = neglected, its size stands in the budget"
    )
    sigma_reflected_K: float = Field(
        0.5, ge=0, le=100, description="of the reflected temperature, measured with crumpled foil"
    )
    operator_m2: float = Field(
        0.0, ge=0, le=5, description="body of who holds the camera, 29 °C warm, that the skin reflects; m²"
    )
    sigma_operator_m2: float = Field(0.3, ge=0, le=5, description="of that area: 0.5 m² is a person at arm's length")
    sigma_room_K: float = Field(
        2.0, ge=0, le=100, description="half the difference between opposite walls, where nothing shows it"
    )
    sigma_normal_deg: float | None = Field(
        None, ge=0, le=45, description="of surface normals; None = estimated from depth noise and window"
    )
    sigma_registration_px: float = Field(
        0.3, ge=0, le=20, description="of the thermal image on the mesh, where the alignment does not measure it"
    )
    sigma_gain: float = Field(
        0.02, ge=0, le=0.5, description="of the camera's gain: data sheets say 2 %; a second reference measures it"
    )
    sigma_depth_scale: float = Field(0.004, ge=0, le=0.1, description="of the depth camera's scale")
    sigma_emissivity0: float = Field(0.01, ge=0, le=0.5, description="of ε(0): enters the absolute level")
    sigma_shape: float = Field(0.15, ge=0, le=2, description="relative uncertainty of 1-ε(θ)'s shape")
    emissivity: EmissivitySection = EmissivitySection()
    crosscal: CrosscalSection = CrosscalSection()


class OutputSection(_Section):
    """What is written."""

    frame: Literal["upright", "world"] = Field(
        "upright", description="upright: y up, z toward who looks at the front; world: the tracking's own frame"
    )
    front: Literal["auto", "front", "back", "left", "right"] = Field(
        "auto",
        description="side of the person that the first depth frame shows; auto: by the feet, else taken for the front",
    )
    formats: list[Literal["ply", "glb", "vtp", "csv"]] = Field(
        ["ply", "glb", "vtp"], description="files of the mesh (docs/formats.md)"
    )
    views: bool = Field(True, description="views/*.png")
    report: bool = Field(True, description="report.html: the result to look at and to measure in, one file")
    compare_methods: bool = Field(False, description="how every other method's temperatures differ, in result.json")
    palette: Literal["inferno", "iron", "grey", "cividis", "rainbow"] = Field(
        "inferno", description="colours of pictures and meshes; rainbow shows edges that are not in the data"
    )
    range_degC: tuple[float, float] | None = Field(
        None, strict=False, description="colour range, low and high; None = 1st to 99th percentile"
    )

    @field_validator("range_degC")
    @classmethod
    def _rising(cls, value: tuple[float, float] | None) -> tuple[float, float] | None:
        if value is not None and not (value[0] >= -100 and value[0] + 0.1 <= value[1] <= 1000):
            raise ValueError("expected low and high between -100 and 1000 °C, low at least 0.1 °C below high")
        return value


class QualitySection(_Section):
    """The gate: below it the result is written, marked, and the exit code is 4."""

    min_tracked_fraction: float = Field(0.8, ge=0, le=1, description="share of the depth frames whose pose is known")
    min_coverage: float = Field(0.5, ge=0, le=1, description="share of the surface with a temperature")
    max_median_sigma_K: float = Field(
        0.5, gt=0, le=100, description="median over the skin of a temperature's one sigma"
    )
    max_voxel_mm: float = Field(15.0, ge=0.5, le=100, description="coarser voxels than asked for, to save memory")


# Where keys of earlier recipes went, the more particular first. They are accepted, with a note.
RENAMED = {
    "crosscal.align": "rig.align",
    "crosscal.motion": "mapping.view_motion",
    "crosscal": "temperature.crosscal",
    "emissivity": "temperature.emissivity",
    "radiometry": "temperature",
    "fusion": "surface",
}
# What earlier versions called the stages, in `--from` and `--until`.
RENAMED_STAGES = {"track": "tracking", "fusion": "surface", "align": "rig", "observe": "mapping"}


class Recipe(_Section):
    """The whole tree."""

    name: str = Field("custom", max_length=200, description="what results call the recipe")
    description: str = Field("", max_length=2000, description="one line for `thermofusion recipe list`")
    input: InputSection = InputSection()
    subject: SubjectSection = SubjectSection()
    tracking: TrackingSection = TrackingSection()
    surface: SurfaceSection = SurfaceSection()
    rig: RigSection = RigSection()
    mapping: MappingSection = MappingSection()
    temperature: TemperatureSection = TemperatureSection()
    output: OutputSection = OutputSection()
    quality: QualitySection = QualitySection()

    @field_validator("name", "description")
    @classmethod
    def _can_be_printed(cls, value: str) -> str:
        if not value.replace("\n", " ").isprintable():
            raise ValueError("it holds a character that cannot be printed")
        return value

    def to_toml(self) -> str:
        """The resolved recipe as TOML; keys whose value is None are left out (their default)."""
        return tomli_w.dumps(self.model_dump(exclude_none=True, mode="json"))


def load_recipe(
    source: str | Path | Mapping[str, Any] = "torso",
    overrides: Sequence[str] = (),
    *,
    note: Callable[[str], None] = lambda _: None,
) -> Recipe:
    """A recipe from a shipped name ("torso"), a TOML file, or a mapping, with `section.key=value` overrides.

    note : told in a sentence where a key has a new name. Raises RecipeError naming the file or the override, the key,
    its nearest match, or what the value must be.
    """
    if isinstance(source, Mapping):
        tree, place = json.loads(json.dumps(source)), "recipe"
    else:
        path = find_recipe(source)
        place = str(path)
        try:
            tree = tomllib.loads(path.read_text(encoding="utf-8"))
        except (ValueError, RecursionError) as e:  # a number of too many digits is a ValueError, too
            raise RecipeError(f"not a TOML file: {e}", place=place) from None
    tree = _under_new_names(tree, note)
    given = [_override(tree, item, note) for item in overrides]
    try:
        return Recipe.model_validate(tree)
    except ValidationError as e:
        loc, sentence = first_fault(Recipe, e)
        for item, key in zip(reversed(overrides), reversed(given), strict=True):
            if key[: len(loc)] == loc or loc[: len(key)] == key:
                place = f"--set {shortened(item)}"
                break
        raise RecipeError(sentence, place=place) from None


def find_recipe(source: str | Path) -> Path:
    """Path of a recipe: an existing file, else a shipped recipe of that name."""
    path = Path(source)
    if path.suffix == ".toml" or path.is_file():
        if not path.is_file():
            raise RecipeError("there is no such recipe file", place=path)
        return path
    shipped = recipes_dir() / f"{source}.toml"
    if shipped.is_file():
        return shipped
    raise RecipeError(
        f"there is no recipe '{source}'{nearest(str(source), shipped_recipes())}",
        hint="`thermofusion recipe list` shows the shipped ones",
    )


def shipped_recipes() -> list[str]:
    """Names of the recipes that come with the package."""
    return sorted(p.stem for p in recipes_dir().glob("*.toml"))


def key_reference() -> str:
    """Every key of the tree with its default and meaning, as Markdown tables (docs/recipes.md)."""
    lines: list[str] = []
    for name, section in _sections(Recipe):
        lines += [f"## `[{name}]`", "", (section.__doc__ or "").strip(), ""]
        lines += ["| key | default | meaning |", "|---|---|---|"]
        for key, field in section.model_fields.items():
            if _is_section(field.annotation):
                continue
            default = "not set" if field.default is None else json.dumps(field.get_default(call_default_factory=True))
            choices = " \\| ".join(f"`{c}`" for c in _choices(field.annotation))
            meaning = "; ".join(part for part in (field.description, choices) if part)
            lines.append(f"| `{key}` | `{default}` | {meaning} |")
        lines.append("")
    return "\n".join(lines)


def _sections(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, type[BaseModel]]]:
    """Dotted names of all sections below a model, outer before inner."""
    for name, field in model.model_fields.items():
        if _is_section(field.annotation):
            section: type[BaseModel] = field.annotation  # type: ignore[assignment]
            yield prefix + name, section
            yield from _sections(section, f"{prefix}{name}.")


def _is_section(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def _choices(annotation: Any) -> tuple[str, ...]:
    """The words a key accepts, if it accepts words."""
    if get_origin(annotation) is Literal:
        return tuple(str(c) for c in get_args(annotation))
    return tuple(c for part in get_args(annotation) for c in _choices(part))


def _under_new_names(tree: dict[str, Any], note: Callable[[str], None]) -> dict[str, Any]:
    """The tree with keys of earlier recipes moved to where they are now."""
    for old, new in RENAMED.items():
        *parents, last = old.split(".")
        node = _node(tree, parents)
        if node is None or last not in node:
            continue
        note(f"the recipe's '{old}' is called '{new}' now")
        value, (*into, name) = node.pop(last), new.split(".")
        target = _node(tree, into, make=True)
        if target is None:
            raise RecipeError(f"'{old}' and '{into[0]}' cannot both be given: '{old}' is called '{new}' now")
        if isinstance(value, dict) and isinstance(target.get(name), dict):
            value = {**value, **target[name]}
        target[name] = value
        if parents and not node:
            tree.pop(parents[0])
    return tree


def _node(tree: dict[str, Any], path: Sequence[str], *, make: bool = False) -> dict[str, Any] | None:
    """The table at a path; None where there is none, or, with `make`, where something else is."""
    for part in path:
        tree = tree.setdefault(part, {}) if make else tree.get(part, {})
        if not isinstance(tree, dict):
            return None
    return tree


def _override(tree: dict[str, Any], item: str, note: Callable[[str], None]) -> tuple[str, ...]:
    """Put `section.key=value` into the tree; returns the key's path, under its new name."""
    key, sep, text = item.partition("=")
    old = key.strip()
    if not sep or not all(part.isidentifier() for part in old.split(".")):
        raise RecipeError(f"--set needs section.key=value, got '{shortened(item)}'")
    new = next((new + old[len(name) :] for name, new in RENAMED.items() if f"{old}.".startswith(f"{name}.")), old)
    if new != old:
        note(f"the recipe's '{old}' is called '{new}' now")
    *parents, last = new.split(".")
    node = _node(tree, parents, make=True)
    if node is None:
        raise RecipeError(f"'{'.'.join(parents)}' has no keys below it", place=f"--set {shortened(item)}")
    try:
        node[last] = json.loads(text)
    except RecursionError:
        raise RecipeError("the value is nested too deep", place=f"--set {shortened(item)}") from None
    except ValueError:  # no JSON: a word
        node[last] = text
    return (*parents, last)
