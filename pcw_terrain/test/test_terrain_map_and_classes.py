"""Places that are remembered, and what a ground is called."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pcw_terrain import CLASSES, GROUNDS, MapParameters, TerrainClass, TerrainError, TerrainMap, classify
from pcw_terrain.terrain_classes import NONE, table

SURE = np.diag([0.03**2, 0.08**2])


@pytest.mark.parametrize("name", CLASSES)
def test_every_class_is_recognised_by_its_own_numbers(name):
    """Asphalt and concrete, dry, are nearly the same: the nearest or the next one then."""
    found = classify(CLASSES[name].mu_p, CLASSES[name].lambda_p, SURE)
    assert name in [c.name for c in found[:2]]
    assert sum(c.probability for c in found) == pytest.approx(1.0)
    assert [c.probability for c in found] == sorted((c.probability for c in found), reverse=True)


def test_a_ground_that_nobody_has_published_is_none_of_these():
    assert classify(1.8, 0.02, SURE)[0].name == NONE
    assert classify(0.03, 0.7, SURE)[0].name == NONE


def test_an_estimate_that_knows_little_leaves_several_classes_open():
    vague = classify(0.8, 0.13, np.diag([0.5**2, 0.5**2]))
    assert vague[0].probability < 0.5 < classify(0.8, 0.13, SURE)[0].probability


def test_a_prior_decides_between_grounds_alike():
    even = {"dry_asphalt": 1.0, "dry_concrete": 1.0}
    indoors = classify(1.13, 0.165, SURE, prior=even | {"dry_concrete": 50.0})
    assert indoors[0].name == "dry_concrete" and indoors[0].probability > 0.9
    with pytest.raises(TerrainError, match="lawn"):
        classify(0.5, 0.1, SURE, prior={"lawn": 1.0})


@settings(max_examples=50, deadline=None)
@given(st.floats(0.02, 2.0), st.floats(0.01, 0.8), st.floats(1e-3, 1.0), st.floats(1e-3, 1.0))
def test_probabilities_are_probabilities(mu_p, lambda_p, mu_spread, lambda_spread):
    found = classify(mu_p, lambda_p, np.diag([mu_spread**2, lambda_spread**2]))
    assert len(found) == len(CLASSES) + 1 and sum(c.probability for c in found) == pytest.approx(1.0)
    assert all(0.0 <= c.probability <= 1.0 for c in found)


def test_every_class_says_where_its_numbers_come_from_and_published_ones_are_the_catalogue():
    for entry in CLASSES.values():
        assert entry.source and (entry.source != "none" or "assumed" in entry.assumed)
        assert entry.name in table()
    for ground in GROUNDS.values():
        assert (CLASSES[ground.name].mu_p, CLASSES[ground.name].lambda_p) == (ground.mu_p, ground.lambda_p)


@pytest.mark.parametrize(
    ("mu_p", "lambda_p", "covariance"),
    [(0.0, 0.1, SURE), (0.5, np.nan, SURE), (0.5, 0.1, np.eye(3)), (0.5, 0.1, -SURE), (0.5, 0.1, np.full((2, 2), np.inf))],
)
def test_what_is_no_estimate_is_refused(mu_p, lambda_p, covariance):
    with pytest.raises(TerrainError, match="allowed"):
        classify(mu_p, lambda_p, covariance)
    with pytest.raises(TerrainError, match="mu_p"):
        TerrainClass("glue", 9.0, 0.1, "none")


# --- Places -----------------------------------------------------------------------------------------------


def test_a_patch_found_once_is_known_next_time():
    map_ = TerrainMap()
    assert map_.at(1.23, -0.4) is None
    assert map_.add(1.23, -0.42, 0.2, 0.06, SURE)
    there = map_.at(1.26, -0.47)  # the same cell of 0.1 m
    assert there.mu_p == pytest.approx(0.2) and there.lambda_p == pytest.approx(0.06)
    assert there.mu_spread == pytest.approx(0.03) and there.lambda_spread == pytest.approx(0.08)
    assert map_.at(1.35, -0.4) is None and map_.known == 1


def test_estimates_of_one_place_are_fused_but_never_surer_than_the_ground_is_even():
    map_ = TerrainMap(MapParameters(least_spread=0.02))
    for mu_p in (0.5, 0.52, 0.48, 0.5):
        map_.add(0.0, 0.0, mu_p, 0.1, np.diag([0.1**2, 0.1**2]))
    assert map_.at(0.0, 0.0).mu_p == pytest.approx(0.5, rel=0.01)
    assert map_.at(0.0, 0.0).mu_spread == pytest.approx(0.05)
    for _ in range(1000):
        map_.add(0.0, 0.0, 0.5, 0.1, np.diag([0.1**2, 0.1**2]))
    assert map_.at(0.0, 0.0).mu_spread == pytest.approx(0.02)


def test_an_estimate_that_contradicts_a_place_replaces_it():
    map_ = TerrainMap()
    for _ in range(5):
        map_.add(0.0, 0.0, 0.8, 0.1, SURE)
    map_.add(0.0, 0.0, 0.2, 0.1, SURE)
    assert map_.at(0.0, 0.0).mu_p == pytest.approx(0.2)


def test_the_occupancy_grid_says_how_slippery_it_is():
    map_ = TerrainMap(MapParameters(resolution=0.5, width=4, height=2, origin=(-1.0, 0.0)))
    map_.add(-0.9, 0.1, 0.05, 0.03, SURE)
    map_.add(0.9, 0.9, 1.1, 0.17, SURE)
    np.testing.assert_array_equal(map_.occupancy(), [[95, -1, -1, -1], [-1, -1, -1, 0]])
    assert map_.occupancy().dtype == np.int8


def test_outside_the_grid_nothing_is_written():
    map_ = TerrainMap(MapParameters(width=10, height=10, origin=(0.0, 0.0)))
    for place in ((-0.01, 0.5), (0.5, 1.01), (np.nan, 0.5), (np.inf, 0.0)):
        assert not map_.add(*place, 0.5, 0.1, SURE) and map_.at(*place) is None
    assert map_.known == 0
    with pytest.raises(TerrainError, match="mu_p"):
        map_.add(0.5, 0.5, -1.0, 0.1, SURE)
    with pytest.raises(TerrainError, match="resolution"):
        MapParameters(resolution=0.0)
