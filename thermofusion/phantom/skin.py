"""What covers a phantom: its true temperature field, its materials, its look."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..types import Float, Float32
from .physics import EmissivityTables, fresnel_emissivity
from .scene import MaterialConfig, SceneConfig, SkinConfig
from .shapes import Mesh

EMISSIVITY_NODES = 4096  # of cosθ; ε has a square-root-free end at 0, linear interpolation errs below 1e-5
WAVES = 48  # plane waves in a random field: close to Gaussian


@dataclass(frozen=True, eq=False)
class Covering:
    """Per vertex (V,): temperature in °C, index of material, albedo; and the materials' ε(θ)."""

    degC: Float32
    material: NDArray[np.int32]
    albedo: Float32
    emissivity: EmissivityTables


def cover(mesh: Mesh, scene: SceneConfig, rng: np.random.Generator) -> Covering:
    """Temperature, materials and patches of a scene on a mesh."""
    degC = temperature_field(mesh, scene.skin, rng)
    material = np.zeros(len(mesh), np.int32)
    albedo = np.ones(len(mesh), np.float32)
    for i, patch in enumerate(scene.patches, 1):
        inside = np.linalg.norm(mesh.vertices_m - np.array(patch.center_m), axis=1) < patch.radius_m
        material[inside], albedo[inside] = i, patch.albedo
        degC[inside] += patch.temperature_shift_K
    tables = [emissivity_row(m) for m in (scene.material, *(p.material for p in scene.patches))]
    return Covering(degC.astype(np.float32), material, albedo, EmissivityTables(np.stack(tables)))


def emissivity_row(material: MaterialConfig) -> Float32:
    """ε (EMISSIVITY_NODES,) at the cosines linspace(0, 1, EMISSIVITY_NODES)."""
    if material.model == "diffuse":
        return np.full(EMISSIVITY_NODES, material.epsilon, np.float32)
    cos_angle = np.linspace(0, 1, EMISSIVITY_NODES)
    return fresnel_emissivity(cos_angle, material.n, material.k).astype(np.float32)


def temperature_field(mesh: Mesh, skin: SkinConfig, rng: np.random.Generator) -> Float:
    """(V,) true temperature of every vertex in °C: smooth pattern, spots, veins, cool extremities."""
    p = mesh.vertices_m.astype(np.float64)
    degC = np.full(len(p), skin.mean_degC)
    if skin.smooth_K:
        degC += skin.smooth_K * random_field(p, skin.smooth_m, rng)
    if skin.veins_K:
        # a vein follows the zero line of a random field: |f| / |grad f| is its distance in metres, |grad f| ~ 2π / size
        distance = np.abs(random_field(p, skin.veins_m, rng)) * skin.veins_m / (2 * np.pi)
        degC += skin.veins_K * np.exp(-0.5 * (distance / skin.vein_width_m) ** 2)
    for i, at in enumerate(spread_points(mesh, skin.spots, rng)):
        size = skin.spot_m * rng.uniform(0.7, 1.4)
        sign = -1 if i % 3 == 2 else 1
        d2 = ((p - at) ** 2).sum(1)
        degC += sign * skin.spot_K * rng.uniform(0.6, 1.2) * np.exp(-0.5 * d2 / size**2)
    if skin.extremities_K:
        degC -= skin.extremities_K * mesh.extremity
    return degC


def random_field(points_m: Float, length_m: float, rng: np.random.Generator) -> Float:
    """A smooth random field of unit variance at points (N, 3): plane waves of about the wavelength `length_m`."""
    direction = Rotation.random(WAVES, rng=rng).as_matrix()[:, :, 0]
    wave_number = 2 * np.pi / length_m * rng.uniform(0.6, 1.4, WAVES)
    phase = points_m @ (direction * wave_number[:, None]).T + rng.uniform(0, 2 * np.pi, WAVES)
    return np.cos(phase).sum(1) * np.sqrt(2 / WAVES)


def spread_points(mesh: Mesh, count: int, rng: np.random.Generator) -> Float:
    """Places (N, 3) m of `count` random vertices far from each other (each the farthest of eight candidates)."""
    chosen: list[Float] = []
    for _ in range(count):
        candidates = mesh.vertices_m[rng.integers(0, len(mesh), 8)].astype(np.float64)
        if chosen:
            gap = np.linalg.norm(candidates[:, None] - np.array(chosen)[None], axis=2).min(1)
            chosen.append(candidates[gap.argmax()])
        else:
            chosen.append(candidates[0])
    return np.array(chosen).reshape(-1, 3)
