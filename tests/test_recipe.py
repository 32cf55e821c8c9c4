"""Recipes: strict, complete, round trip."""

from __future__ import annotations

import tomllib

import pytest

from thermofusion.errors import RecipeError
from thermofusion.recipe import Recipe, load_recipe, shipped_recipes

SHIPPED = ["full-body", "head", "limb", "phantom-cylinder", "room", "torso", "turntable-object"]


def test_the_shipped_recipes_are_there_commented_and_round_trip():
    assert shipped_recipes() == SHIPPED
    for name in SHIPPED:
        recipe = load_recipe(name)
        assert recipe.name == name
        assert recipe.description
        assert Recipe.model_validate(tomllib.loads(recipe.to_toml())) == recipe


@pytest.mark.parametrize(
    ("tree", "words"),
    [
        ({"surface": {"voxelmm": 3}}, ["surface.voxelmm", "voxel_mm"]),
        ({"surfcae": {}}, ["surfcae", "surface"]),
        ({"temperature": {"emissivity": {"model": "dielektrik"}}}, ["emissivity.model", "dielectric"]),
        ({"mapping": {"silhouette_px": -1}}, ["mapping.silhouette_px", "expected 0 to 100 px"]),
        ({"input": {"max_depth_m": "far"}}, ["input.max_depth_m", "far"]),
        ({"input": {"max_depth_m": float("nan")}}, ["input.max_depth_m", "finite"]),
    ],
)
def test_a_fault_is_named_with_its_key_and_the_nearest_match(tree, words):
    with pytest.raises(RecipeError) as caught:
        load_recipe(tree)
    assert all(word in str(caught.value) for word in words)
    assert caught.value.exit_code == 2


def test_overrides_come_last_and_are_typed(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('[surface]\nvoxel_mm = 4\n[temperature.emissivity]\nmodel = "water"\n')
    recipe = load_recipe(path, ["surface.voxel_mm=3", "tracking.refine=true", "output.range_degC=[26,36]"])
    assert recipe.surface.voxel_mm == 3
    assert recipe.tracking.refine is True
    assert recipe.output.range_degC == (26.0, 36.0)
    assert recipe.temperature.emissivity.model == "water"
    with pytest.raises(RecipeError, match=r"--set needs section\.key=value"):
        load_recipe(path, ["surface.voxel_mm"])
    with pytest.raises(RecipeError, match="did you mean 'torso'"):
        load_recipe("tors")
    with pytest.raises(RecipeError, match="no such recipe file"):
        load_recipe(tmp_path / "absent.toml")


def test_keys_of_earlier_recipes_are_accepted_with_a_note():
    old = {"fusion": {"voxel_mm": 4}, "radiometry": {"method": "mean"}, "emissivity": {"n": 1.4}}
    old["crosscal"] = {"align": False, "motion": True, "shape": False}
    notes: list[str] = []
    recipe = load_recipe(old, ["fusion.smooth_iterations=2", "crosscal.offsets=false"], note=notes.append)
    new = {"surface": {"voxel_mm": 4, "smooth_iterations": 2}, "rig": {"align": False}}
    new["mapping"] = {"view_motion": True}
    new["temperature"] = {"method": "mean", "emissivity": {"n": 1.4}, "crosscal": {"shape": False, "offsets": False}}
    assert recipe == load_recipe(new)
    assert "the recipe's 'fusion' is called 'surface' now" in notes
    assert "the recipe's 'crosscal.offsets' is called 'temperature.crosscal.offsets' now" in notes
    assert load_recipe(new, note=pytest.fail) == recipe


@pytest.mark.parametrize(
    ("item", "words"),
    [
        ("surface.voxel_mm=0", ["--set surface.voxel_mm=0", "0.5 to 100 mm", "got 0"]),
        ("surface.voxel_mm=true", ["0.5 to 100 mm", "got True"]),
        ("input.min_depth_m=2.9", ["input", "below max_depth_m"]),
        ("mapping.last_resort_angle_deg=20", ["at least 65"]),
        ("input=5", ["--set input=5", "table of keys"]),
        ("name.x=1", ["name", "no keys below it"]),
        ("input=" + "[" * 100_000, ["nested too deep"]),
        ("input.max_depth_m=" + "9" * 6000, ["0.1 to 20 m"]),
        ("output.formats=ply", ["list"]),
    ],
)
def test_a_fault_of_an_override_names_the_override_and_the_bounds_with_their_unit(item, words):
    with pytest.raises(RecipeError) as caught:
        load_recipe("torso", [item])
    sentence = str(caught.value)
    assert all(word in sentence for word in words), sentence
    assert ".toml" not in sentence
    assert len(sentence) < 300


def test_a_torn_file_is_one_sentence(tmp_path):
    path = tmp_path / "torn.toml"
    path.write_text("[surface\nvoxel_mm = 4")
    with pytest.raises(RecipeError, match="not a TOML file"):
        load_recipe(path)


def test_every_key_says_what_it_does():
    for section in Recipe.model_fields.values():
        fields = getattr(section.annotation, "model_fields", {})
        assert section.annotation is str or fields, section
        if fields:
            assert section.annotation.__doc__
