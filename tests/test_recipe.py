"""Recipes: strict, complete, round trip."""

from __future__ import annotations

import tomllib

import pytest

from thermofusion.errors import RecipeError
from thermofusion.recipe import Recipe, load_recipe, shipped_recipes

SHIPPED = ["full-body", "head", "limb", "phantom-cylinder", "torso", "turntable-object"]


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
        ({"fusion": {"voxelmm": 3}}, ["fusion.voxelmm", "voxel_mm"]),
        ({"fusoin": {}}, ["fusoin", "fusion"]),
        ({"emissivity": {"model": "dielektrik"}}, ["emissivity.model", "dielectric"]),
        ({"mapping": {"silhouette_px": -1}}, ["mapping.silhouette_px", "greater than or equal to 0"]),
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
    path.write_text('[fusion]\nvoxel_mm = 4\n[emissivity]\nmodel = "water"\n')
    recipe = load_recipe(path, ["fusion.voxel_mm=3", "tracking.refine=true", "output.range_degC=[26,36]"])
    assert recipe.fusion.voxel_mm == 3
    assert recipe.tracking.refine is True
    assert recipe.output.range_degC == (26.0, 36.0)
    assert recipe.emissivity.model == "water"
    with pytest.raises(RecipeError, match=r"--set needs section\.key=value"):
        load_recipe(path, ["fusion.voxel_mm"])
    with pytest.raises(RecipeError, match="did you mean 'torso'"):
        load_recipe("tors")
    with pytest.raises(RecipeError, match="no such recipe file"):
        load_recipe(tmp_path / "absent.toml")


def test_a_torn_file_is_one_sentence(tmp_path):
    path = tmp_path / "torn.toml"
    path.write_text("[fusion\nvoxel_mm = 4")
    with pytest.raises(RecipeError, match="not a TOML file"):
        load_recipe(path)


def test_every_key_says_what_it_does():
    for section in Recipe.model_fields.values():
        fields = getattr(section.annotation, "model_fields", {})
        assert section.annotation is str or fields, section
        if fields:
            assert section.annotation.__doc__
