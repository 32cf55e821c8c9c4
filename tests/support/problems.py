"""Temperature problems of synthetic worlds: observations and what is known, without a scan."""

from __future__ import annotations

import numpy as np
from support.synthetic_views import BAND, HEIGHT, L_ROOM, REFLECTED_K, WIDTH

from thermofusion.physics.emissivity import Fresnel
from thermofusion.recipe import MappingSection, TemperatureSection
from thermofusion.temperature.problem import ThermalProblem
from thermofusion.temperature.room.stated import Room
from thermofusion.temperature.uncertainty import ErrorModel
from thermofusion.types import Camera

LENS = Camera(WIDTH, HEIGHT, np.array([[300.0, 0, WIDTH / 2], [0, 300.0, HEIGHT / 2], [0, 0, 1]]))
COARSE = {"netd_K": 0.05, "sigma_normal_deg": 2.0, "sigma_shape": 0.15, "sigma_registration_px": 0.5}
COARSE |= {"sigma_reflected_K": 1.0, "sigma_emissivity0": 0.01}


def errors(netd_K=0.05, **changes):
    """An error model with a Kinect's normals and a rig aligned by hand, but for the changes."""
    return ErrorModel(**(COARSE | {"netd_K": netd_K} | changes))


EXACT = errors(sigma_normal_deg=0.5, sigma_registration_px=0.0)


def problem_of(observations, n_vertices, n_views, *, settings=None, mapping=None, L_reflected=L_ROOM, **known):
    """Every observation is clear of outlines; what is not named is a bare world's."""
    settings, mapping = settings or TemperatureSection(), mapping or MappingSection()
    straight = observations.cos_angle >= np.float32(np.cos(np.radians(mapping.max_angle_deg)))
    straight_seen = np.bincount(observations.vertex[straight], minlength=n_vertices) > 0
    given = {
        "vertices": np.arange(n_vertices),
        "observations": observations,
        "clear": np.ones(len(observations), bool),
        "counts": straight | ~straight_seen[observations.vertex],
        "points_m": np.random.default_rng(7).uniform(0.0, 0.4, (n_vertices, 3)).astype(np.float32),
        "n_views": n_views,
        "view_times_s": 0.2 * np.arange(n_views),
        "restarts": (),
        "lens": LENS,
        "band": BAND,
        "emissivity": Fresnel(1.33),
        "room": Room(REFLECTED_K, None),
        "L_reflected": np.broadcast_to(np.asarray(L_reflected, float), (n_vertices,)),
        "around": None,
        "errors": EXACT,
        "blackbodies": (),
        "contacts": (),
        "vertices_per_patch": 1.0,
        "mapping": mapping,
        "settings": settings,
    }
    return ThermalProblem(**(given | known))
