"""ε(θ) against golden values (direct complex Fresnel, checked with an independent thin-film package to 1e-15)."""

from itertools import pairwise

import numpy as np
import pytest

from thermofusion.errors import RecipeError
from thermofusion.files.shipped import data_dir
from thermofusion.physics.band import Band
from thermofusion.physics.emissivity import (
    AngleTable,
    Blackbody,
    Cosine,
    EmissivityModel,
    Fresnel,
    Scaled,
    Tabulated,
    fresnel_reflectivity,
    model_from_recipe,
    reshaped,
    shape_direction,
    water,
)
from thermofusion.recipe import EmissivitySection

ANGLES = [0, 10, 20, 30, 40, 50, 60, 70, 80, 85, 89]
GOLDEN = {
    Fresnel(1.33): [
        *(0.9799406878, 0.9799303150, 0.9797602853, 0.9788875421, 0.9758480376, 0.9667501370),
        *(0.9408744008, 0.8673433963, 0.6530839037, 0.4172717551, 0.1039534948),
    ],
    Fresnel(1.33, 0.25): [
        *(0.9687875587, 0.9687720960, 0.9685203703, 0.9672467965, 0.9629220181, 0.9504977124),
        *(0.9173222454, 0.8311446718, 0.6068646467, 0.3796290041, 0.0927554121),
    ],
    Fresnel(2.84): [
        *(0.7703993056, 0.7703884850, 0.7702185758, 0.7694129925, 0.7669062614, 0.7603424699),
        *(0.7439272474, 0.7006281216, 0.5666087018, 0.3921550387, 0.1084856587),
    ],
    Fresnel(2.84, 0.0003): [
        *(0.7703993009, 0.7703884803, 0.7702185711, 0.7694129878, 0.7669062568, 0.7603424654),
        *(0.7439272433, 0.7006281181, 0.5666086996, 0.3921550375, 0.1084856584),
    ],
    Cosine(): [
        *(0.9800000000, 0.9651115980, 0.9208987684, 0.8487048957, 0.7507235543, 0.6299318575),
        *(0.4900000000, 0.3351797405, 0.1701752141, 0.0854126279, 0.0171033583),
    ],
}
SKIN = {"dielectric": Fresnel(1.33), "non-dielectric": Fresnel(1.33, 0.25), "water": water(Band())}


def mu(degrees):
    return np.cos(np.radians(degrees))


@pytest.mark.parametrize("model", GOLDEN, ids=str)
def test_golden_table(model):
    np.testing.assert_allclose(model(mu(ANGLES)), GOLDEN[model], atol=6e-11, rtol=0)


def test_reflectivity_golden():
    r_s, r_p = fresnel_reflectivity(0.5, 1.33 + 0.25j)
    assert r_s == pytest.approx(0.1574806983, abs=6e-11)
    assert r_p == pytest.approx(0.0078748109, abs=6e-11)


def test_water_golden():
    golden = [0.9862807, 0.9861271, 0.9826855, 0.9501604, 0.8791004, 0.6660194, 0.4271758]
    np.testing.assert_allclose(SKIN["water"](mu([0, 20, 40, 60, 70, 80, 85])), golden, atol=6e-8)


def test_water_against_a_third_party():
    """Reflectivity of water at 8-14 µm (Segelstein, 293 K), printed to three digits."""
    printed = [0.013, 0.014, 0.020, 0.050, 0.122, 0.200, 0.336, 0.574, 0.799]
    got = 1 - water(Band(7.5, 13.5))(mu([0, 30, 45, 60, 70, 75, 80, 85, 88]))
    assert np.abs(got - printed).max() < 5e-3


def test_fitted_index_is_water_at_skin_temperature():
    """(1.2233, 0.1304) against Nalli et al. 2022 at 307 K, even in wavelength from the table's end, 7.9 µm, to 13.5."""
    path = data_dir() / "tables" / "nalli2022_water_nk_307_311.csv"
    wavenumber, n, k, _, _ = np.loadtxt(path, delimiter=",").T
    lam = 1e4 / wavenumber
    use = lam <= 13.5
    weight = lam[use] ** 2  # the table is even in wavenumber: dλ = λ² dν
    angles = np.arange(0, 86)
    r_s, r_p = fresnel_reflectivity(mu(angles)[:, None], n[use] + 1j * k[use])
    band_average = 1 - 0.5 * ((r_s + r_p) @ weight) / weight.sum()
    fitted = model_from_recipe(EmissivitySection(model="fitted"), Band())
    assert np.abs(fitted(mu(angles)) - band_average).max() < 1.2e-3


def test_fresnel_equals_the_papers_printed_form():
    """Eqs. 13-14 for a dielectric, written out with Snell's law."""
    theta = np.radians(np.arange(1, 89))
    t = np.arcsin(np.sin(theta) / 1.33)
    R = 0.5 * ((np.sin(theta - t) / np.sin(theta + t)) ** 2 + (np.tan(theta - t) / np.tan(theta + t)) ** 2)
    np.testing.assert_allclose(Fresnel(1.33)(np.cos(theta)), 1 - R, atol=1e-14)


def test_extinction_goes_smoothly_to_none():
    """The paper's Eq. 20 cancels badly at small k; the complex form does not."""
    c = mu(np.arange(0, 90))
    base = Fresnel(2.84)(c)
    steps = [np.abs(Fresnel(2.84, k)(c) - base).max() for k in (1e-2, 1e-4, 1e-6, 1e-8)]
    assert steps[0] < 1e-5
    assert all(b <= 1.1e-4 * a + 1e-15 for a, b in pairwise(steps))


@pytest.mark.parametrize("model", [*SKIN.values(), Fresnel(2.84), Cosine(), Blackbody()], ids=str)
def test_derivative_and_table(model):
    theta = np.radians(np.arange(2, 86, 3))
    h = 1e-4
    at = [model(np.cos(theta + j * h)) for j in (-2, -1, 1, 2)]
    five_point = (at[0] - 8 * at[1] + 8 * at[2] - at[3]) / (12 * h)
    np.testing.assert_allclose(model.derivative(theta), five_point, atol=1e-8)
    c = np.random.default_rng(0).uniform(0.1, 1, 50_000)
    table = AngleTable.of(model)
    assert table(c).dtype == np.float32
    assert np.abs(table(c) - model(c)).max() < 5e-7
    assert table(np.array([1.0 + 1e-7])) == pytest.approx(model.normal, abs=1e-7)


def test_hemispherical_of_known_models():
    assert Blackbody().hemispherical == pytest.approx(1.0)
    assert Cosine(0.9).hemispherical == pytest.approx(0.6)  # 2 ∫ 0.9 μ² dμ


def test_tabulated_goes_through_its_table_and_is_monotone():
    angles = np.array([0, 20, 40, 60, 80.0])
    model = Tabulated(angles, Fresnel(1.33)(mu(angles)))
    np.testing.assert_allclose(model(mu(angles)), Fresnel(1.33)(mu(angles)), atol=1e-12)
    assert (np.diff(model(mu(np.linspace(0, 90, 500)))) <= 1e-12).all()
    assert model(0.0) == pytest.approx(0, abs=1e-12)
    fine = Tabulated(np.arange(0, 91, 2.5), Fresnel(1.33)(mu(np.arange(0, 91, 2.5))).clip(1e-9))
    assert np.abs(fine(mu(np.arange(0, 70))) - Fresnel(1.33)(mu(np.arange(0, 70)))).max() < 3e-4


def test_scaled_keeps_the_shape():
    model = Scaled(Fresnel(1.33), 0.97)
    assert model.normal == pytest.approx(0.97)
    np.testing.assert_allclose(model.relative(mu(ANGLES)), Fresnel(1.33).relative(mu(ANGLES)), atol=1e-14)


# ---------------------------------------------------------------- the fitted shape


@pytest.mark.parametrize("start", SKIN)
@pytest.mark.parametrize("goal", SKIN)
def test_one_parameter_carries_each_preset_into_the_others(start, goal):
    """To 3 mK on skin 10 K above the room, up to 65°; and ε(0) to 0.004 (40 mK; 0.02 would be declared)."""
    theta = np.arange(0, 65.5, 0.5)
    D = shape_direction(mu(theta))
    gap = SKIN[goal].relative(mu(theta)) - SKIN[start].relative(mu(theta))
    s = float(gap @ D / (D @ D))
    fitted = reshaped(SKIN[start], s)
    excess_K = 10.0
    assert excess_K * np.abs(fitted.relative(mu(theta)) - SKIN[goal].relative(mu(theta))).max() < 3e-3
    assert abs(fitted.normal - SKIN[goal].normal) < 0.004


def test_a_declared_emissivity_stays():
    assert reshaped(Scaled(Fresnel(1.33), 0.97), 0.8).normal == pytest.approx(0.97)
    assert reshaped(Fresnel(2.84), 0.8).normal == pytest.approx(Fresnel(2.84).normal)
    assert reshaped(Fresnel(1.33), 0.0) == Fresnel(1.33)
    assert (reshaped(Blackbody(), -1.5)(mu(np.arange(0, 90))) <= 1).all()


# ---------------------------------------------------------------- recipes


@pytest.mark.parametrize(
    ("section", "model"),
    [
        ({"model": "dielectric"}, Fresnel(1.33)),
        ({"model": "dielectric", "n": 2.84}, Fresnel(2.84)),
        ({"model": "non-dielectric"}, Fresnel(1.33, 0.25)),
        ({"model": "non-dielectric", "k": 0.166}, Fresnel(1.33, 0.166)),
        ({"model": "fitted"}, Fresnel(1.2233, 0.1304)),
        ({"model": "cosine"}, Cosine(0.98)),
        ({"model": "blackbody"}, Blackbody()),
        ({"model": "dielectric", "epsilon0": 0.97}, Scaled(Fresnel(1.33), 0.97)),
    ],
)
def test_recipe_models(section, model):
    assert model_from_recipe(EmissivitySection(**section), Band()) == model


@pytest.mark.parametrize(
    ("section", "band", "message"),
    [
        ({"model": "tabulated"}, Band(), "angles_deg"),
        ({"model": "tabulated", "angles_deg": [0, 30, 20], "values": [0.9, 0.9, 0.9]}, Band(), "rising"),
        ({"model": "tabulated", "angles_deg": [0, 30], "values": [0.9, 0.0]}, Band(), r"\(0, 1\]"),
        ({"model": "water"}, Band(3, 5), "water model is tabulated"),
        ({"model": "dielectric", "k": 0.2}, Band(), "emissivity.k.*no extinction"),
    ],
)
def test_recipes_that_do_not_fit(section, band, message):
    with pytest.raises(RecipeError, match=message):
        model_from_recipe(EmissivitySection(**section), band)


def test_angle_table_ends():
    table = AngleTable.of(np.linspace(0, 2, len(AngleTable.knots())))
    np.testing.assert_allclose(table(np.array([-0.1, 0.0, 0.25, 1.0, 1.2])), [0, 0, 0.5, 2, 2], atol=1e-6)
    assert isinstance(Fresnel(1.5), EmissivityModel)
