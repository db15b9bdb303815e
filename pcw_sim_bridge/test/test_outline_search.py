"""Outlines of patches of floor, found from what wheels feel that cross them."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from pcw_sim_bridge.mismatch.findings.explanation import named_terms
from pcw_sim_bridge.mismatch.regression.regression_problem import (
    Channel,
    LinearParameter,
    RegressionProblem,
    Term,
)
from pcw_sim_bridge.mismatch.regression.whitened_regression import Instance
from pcw_sim_bridge.mismatch.search.effect_gates import EffectGates
from pcw_sim_bridge.mismatch.search.evidence_selection import EffectSearch
from pcw_sim_bridge.mismatch.search.outline_search import (
    OTHERS,
    OUTLINE,
    Outlines,
    has_outline,
    reaching,
    searched_outline,
)
from pcw_sim_bridge.mismatch.search.shape_search import DROP
from pcw_sim_bridge.mismatch.search.shape_trials import ShapeTrials

NOISE = 0.05
DISC = {"x": 0.05, "y": 0.05, "length": 0.5, "width": 0.5, "yaw": 0.0, "roundness": 1.0}


def inside(places: np.ndarray, outline: dict[str, float]) -> np.ndarray:
    """1 within a rectangle, an ellipse or what lies between, 0 outside, over a border of 2 cm; places (T, 2)."""
    c, s = math.cos(outline["yaw"]), math.sin(outline["yaw"])
    apart = places - [outline["x"], outline["y"]]
    along = np.abs(apart @ [c, s]) / (0.5 * outline["length"])
    across = np.abs(apart @ [-s, c]) / (0.5 * outline["width"])
    power = 2.0 / max(outline["roundness"], 0.04)
    radius = np.minimum((np.minimum(along, 9.0) ** power + np.minimum(across, 9.0) ** power) ** (1.0 / power), 9.0)
    return np.clip(0.5 + (1.0 - radius) * 0.5 * min(outline["length"], outline["width"]) / 0.02, 0.0, 1.0)


def tracks(lines: int) -> np.ndarray:
    """Places (T, 2) [m] of a wheel that crosses a floor of 2 m by 2 m to and fro, first along it, then across."""
    along = np.linspace(-1.0, 1.0, 200)
    rows = [np.column_stack([along, np.full_like(along, y)]) for y in np.linspace(-0.93, 0.97, lines)]
    return np.concatenate([*rows, *(row[:, ::-1] for row in rows)])


def floor_problem(places: np.ndarray, outline: dict[str, float], size: float) -> RegressionProblem:
    """A patch that moves one channel by so much, beside white noise."""
    rng = np.random.default_rng(1)
    residual = (size * inside(places, outline) + NOISE * rng.standard_normal(len(places)))[:, None]
    time = np.arange(len(places)) / 50.0
    grid = {"x": ("linear", 0.1), "y": ("linear", 0.1), "length": ("log", 1.6), "width": ("log", 1.6)}
    return RegressionProblem(
        channels=(Channel("axis_force", "N"),), time=time, segment=np.zeros(len(time), dtype=np.int64),
        recording=np.zeros(len(time), dtype=np.int64), rate=50.0, measured=residual, residual=residual,
        valid=np.ones_like(residual, dtype=bool), nuisances=(), variables={"time": time},
        terms=(
            Term(
                "patch", ("axis",), (LinearParameter("size", "1", -10.0, 10.0, 1.0),), (DISC,),
                lambda shape: inside(places, shape)[:, None, None], resolution=grid, once=True,
            ),
        ),
    )  # fmt: skip


def shaped(outline: dict[str, float]) -> Instance:
    """The patch of that outline."""
    return Instance(0, tuple(sorted(outline.items())), (0,))


@pytest.mark.parametrize(
    "outline",
    [
        {"x": 0.1, "y": 0.02, "length": 0.66, "width": 0.38, "yaw": 0.7, "roundness": 0.0},
        *(
            pytest.param(outline, marks=pytest.mark.nightly)
            for outline in (
                {"x": 0.03, "y": 0.12, "length": 0.8, "width": 0.5, "yaw": -0.5, "roundness": 1.0},
                {"x": 0.05, "y": 0.05, "length": 0.45, "width": 0.45, "yaw": 0.0, "roundness": 1.0},
            )
        ),
    ],
)
def test_the_outline_of_a_patch_is_found_from_that_of_a_disc(outline):
    """A turned rectangle, a turned ellipse, a disc; from the place and size of a first look."""
    problem = floor_problem(tracks(24), outline, 0.3)
    regression = EffectSearch(problem, np.random.default_rng(0)).whiten_at(problem.residual)
    (found, *_), tried = searched_outline(regression, (), shaped(DISC))
    shape = dict(found.shape)
    # Tracks are 8 cm apart; a border is known to a part of that.
    for name in ("x", "y", "length", "width"):
        assert shape[name] == pytest.approx(outline[name], abs=0.06), name
    assert shape["roundness"] == pytest.approx(outline["roundness"], abs=0.4)
    if outline["length"] > outline["width"]:
        assert shape["yaw"] == pytest.approx(outline["yaw"], abs=0.12)
    # Not by chance: the true one is hardly better.
    trials = ShapeTrials(regression, (), found)
    best, true = (trial.evidence for trial in trials.tried([found, shaped(outline)]))
    assert best > true - 2.0
    assert best <= tried.evidence.max() + 1e-6


@pytest.mark.parametrize("seed", [17, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in (8, 15, 32))])
def test_a_small_patch_is_found_from_a_disc_far_too_large(seed):
    """Four wheels cross a patch now and then, pushed either way or not at all: about all the places a large disc fits as well.

    It is a hill of its own: outlines led from it to others beside the patch, worse by 20 to 40 nats.
    """
    rng = np.random.default_rng(seed)
    turn, amplitude, phase = np.linspace(0.0, 2.0 * np.pi, 2000), rng.uniform(0.6, 1.0, 2), rng.uniform(0.0, 6.28, 3)
    middle = np.column_stack([amplitude[0] * np.cos(turn + phase[0]), amplitude[1] * np.sin(2.0 * turn + phase[1])])
    c, s = np.cos(turn + phase[2]), np.sin(turn + phase[2])
    corners = [(0.25, 0.2), (0.25, -0.2), (-0.25, 0.2), (-0.25, -0.2)]
    wheels = [middle + np.column_stack([x * c - y * s, x * s + y * c]) for x, y in corners]
    pushed = [np.repeat(rng.choice([-1.0, 0.0, 1.0], 40), 50) for _ in wheels]
    at, width = wheels[rng.integers(4)][rng.integers(2000)], rng.uniform(0.2, 0.4)
    outline = {"x": at[0], "y": at[1], "length": width * rng.uniform(1.0, 2.0), "width": width, "yaw": rng.uniform(-1.0, 1.0)}
    outline |= {"roundness": 0.0}
    side = rng.uniform(1.2, 1.8)
    apart, way = rng.uniform(0.3, 0.5) * side, rng.uniform(0.0, 6.28)
    disc = DISC | {"x": at[0] + apart * np.cos(way), "y": at[1] + apart * np.sin(way), "length": side, "width": side}

    def felt(shape: dict[str, float]) -> np.ndarray:
        return np.stack([inside(places, shape) * push for places, push in zip(wheels, pushed)], axis=1)

    residual = felt(outline) + NOISE * rng.standard_normal((2000, 4))
    problem = floor_problem(wheels[0], outline, 0.0)
    problem = dataclasses.replace(
        problem, channels=tuple(Channel(f"axis_force/{k}", "N") for k in range(4)), measured=residual, residual=residual,
        valid=np.ones_like(residual, dtype=bool),
        terms=(dataclasses.replace(problem.terms[0], columns=lambda shape: felt(shape)[:, :, None]),),
    )  # fmt: skip
    regression = EffectSearch(problem, np.random.default_rng(0)).whiten_at(problem.residual)
    (found, *_), _ = searched_outline(regression, (), shaped(disc))
    best, true = (trial.evidence for trial in ShapeTrials(regression, (), found).tried([found, shaped(outline)]))
    assert best > true - 4.0


def test_where_few_wheels_crossed_a_patch_its_interval_holds_what_else_it_may_be():
    """One track each way: discs and rectangles of many directions do. Beside them each interval was below a centimetre.

    Mirrored in the track along x, at y = 0.02, a patch is crossed alike: which of the two, nothing tells.
    """
    outline = {"x": 0.2, "y": 0.1, "length": 0.9, "width": 0.7, "yaw": 0.4, "roundness": 0.0}
    problem = floor_problem(tracks(3), outline, 0.3)
    search = EffectSearch(problem, np.random.default_rng(0))
    selection = search.with_outlines(search.conclude((shaped(DISC),), 5.0))
    assert set(search.outlines) == {0}
    estimates = named_terms(search, selection)[0].estimates
    mirrored = outline | {"y": 0.04 - outline["y"], "yaw": -outline["yaw"]}
    nearest = min(outline, mirrored, key=lambda known: abs(known["yaw"] - estimates["yaw"].value))
    for name in OUTLINE[:4]:
        assert estimates[name].value == pytest.approx(nearest[name], abs=0.15), name
    assert estimates["y"].high - estimates["y"].low > 0.02
    for known in (outline, mirrored):
        assert estimates["yaw"].low < known["yaw"] < estimates["yaw"].high
    trials = ShapeTrials(selection.regression, (), selection.fit.instances[0])
    found, true = (trial.evidence for trial in trials.tried([selection.fit.instances[0], shaped(outline)]))
    assert found > true - 2.0
    assert estimates["size"].low < 0.3 < estimates["size"].high


def test_an_outline_is_that_by_the_model_itself_and_not_by_its_first_order():
    """What slips on a patch slips a while beyond it: by the first order of a small one a large one is as long as that.

    One of 0.46 m by 0.59 m was told to be 2 m long, since outlines that differed by centimetres did by hundreds of nats.
    """
    outline = {"x": 0.1, "y": 0.02, "length": 0.66, "width": 0.38, "yaw": 0.7, "roundness": 0.0}
    places = tracks(24)

    def work(shape: dict[str, float], size: float) -> np.ndarray:
        grown = {side: shape[side] * (1.0 + 0.5 * size) for side in ("length", "width")}
        return size * inside(places, shape | grown)[:, None]

    problem = floor_problem(places, outline, 0.0)
    measured = work(outline, 0.6) + problem.residual
    term = dataclasses.replace(
        problem.terms[0], columns=lambda shape: (work(shape, 0.01) / 0.01)[:, :, None], is_exact=True, is_curved=True
    )
    problem = dataclasses.replace(
        problem, measured=measured, residual=measured, terms=(term,),
        exact=lambda changes, sizes: (measured - sum(work(dict(s.shape), float(s.coefficients[0])) for s in sizes), []),
    )  # fmt: skip
    search = EffectSearch(problem, np.random.default_rng(0))
    (first, *_), _ = searched_outline(search.whiten_at(problem.residual), (), shaped(DISC))
    assert dict(first.shape)["length"] > outline["length"] + 0.1
    selection = search.conclude(search.made_exact((shaped(DISC),)), 5.0)
    shape = dict(search.with_outlines(selection).fit.instances[0].shape)
    for name in ("x", "y", "length", "width"):
        assert shape[name] == pytest.approx(outline[name], abs=0.06), name


@pytest.mark.parametrize("seed", [0, pytest.param(4, marks=pytest.mark.nightly)])
def test_a_border_that_few_wheels_crossed_is_within_its_interval(seed):
    """A search stays where it is best: of what does nearly as well further away it met some by chance, and told no others."""
    rng = np.random.default_rng(seed)
    length, width = np.sort(rng.uniform(0.5, 1.0, 2))[::-1]
    outline = {"x": rng.uniform(-0.2, 0.2), "y": rng.uniform(-0.2, 0.2), "length": length, "width": width}
    outline |= {"yaw": rng.uniform(-1.0, 1.0), "roundness": 1.0}
    problem = floor_problem(tracks(6), outline, 0.3)
    search = EffectSearch(problem, np.random.default_rng(0))
    search.with_outlines(search.conclude((shaped(DISC),), 5.0))
    ranges, _ = search.outlines[0].ranges(DROP)
    for name in OUTLINE[:4]:
        low, high = ranges[name]
        assert low < outline[name] < high, name


def test_no_border_is_known_better_than_where_a_tyre_feels_it():
    """Many crossings told borders to half a millimetre, and another simulator's wheels felt them some millimetres off."""
    outline = {"x": 0.1, "y": 0.02, "length": 0.66, "width": 0.38, "yaw": 0.7, "roundness": 0.0}
    problem = floor_problem(tracks(48), outline, 5.0)
    (term,), blur = problem.terms, {"x": 0.002, "y": 0.002, "length": 0.004, "width": 0.004}
    for deviations in ({}, blur):
        problem = dataclasses.replace(problem, terms=(dataclasses.replace(term, blur=deviations),))
        search = EffectSearch(problem, np.random.default_rng(0))
        estimates = named_terms(search, search.conclude((shaped(outline),), 5.0))[0].estimates
        halves = {name: 0.5 * (estimates[name].high - estimates[name].low) for name in blur}
        for name, half in halves.items():
            least = 1.96 * deviations.get(name, 0.0)
            assert least <= half < least + 0.002, name


def test_a_patch_is_judged_in_its_own_outline_and_not_in_that_of_a_first_look():
    """A disc in the middle of a strip leaves more beside it than it explains: so a patch of 2800 nats was dropped."""
    strip = {"x": 0.1, "y": 0.0, "length": 1.5, "width": 0.3, "yaw": 0.8, "roundness": 0.0}
    problem = floor_problem(tracks(32), strip, 0.3)
    disc = shaped(DISC | {"x": 0.1, "y": 0.0})
    search = EffectSearch(problem, np.random.default_rng(0))
    regression = search.whiten_beside((disc,))
    assert EffectGates(problem, search.settings).judge(regression, (disc,), regression.fit((disc,)))[2][0] < 1.0
    [patch] = search.prune(regression, (disc,), 9.0).fit.instances
    shape = dict(patch.shape)
    for name in ("x", "y", "length", "width"):
        assert shape[name] == pytest.approx(strip[name], abs=0.06), name


def test_a_patch_where_nobody_came_is_nothing():
    """A shape may be asked for beside all tracks: it is worth nothing, and no error."""
    problem = floor_problem(tracks(3), DISC, 0.3)
    search = EffectSearch(problem, np.random.default_rng(0))
    selection = search.conclude((shaped(DISC | {"x": 0.5, "y": 0.5, "length": 0.2, "width": 0.2}),), 5.0)
    assert selection.losses == (pytest.approx(0.0, abs=1e-6),)


def test_no_outline_is_searched_for_a_patch_that_cannot_be():
    """Its size would have to be of the other sign: whatever outline came out would be as wrong."""
    problem = floor_problem(tracks(12), DISC, -0.3)
    positive = dataclasses.replace(problem.terms[0].parameters[0], lower=0.0)
    problem = dataclasses.replace(problem, terms=(dataclasses.replace(problem.terms[0], parameters=(positive,)),))
    regression = EffectSearch(problem, np.random.default_rng(0)).whiten_at(problem.residual)
    assert searched_outline(regression, (), shaped(DISC)) == ([shaped(DISC)], None)
    before = Outlines(np.array([[DISC[name] for name in OUTLINE]]), np.zeros(1), np.zeros((1, 1)))
    assert reaching(regression, (), shaped(DISC), before, DROP) is before


def test_what_was_tried_is_told_upright():
    """The longer side is the length, and a direction one of half a turn: one outline has one name."""
    outline = {"x": 0.0, "y": 0.0, "length": 0.4, "width": 0.8, "yaw": 2.0, "roundness": 0.0}
    problem = floor_problem(tracks(24), outline, 0.3)
    regression = EffectSearch(problem, np.random.default_rng(0)).whiten_at(problem.residual)
    (found, *_), tried = searched_outline(regression, (), shaped(outline | {"x": 0.03}))
    shape = dict(found.shape)
    assert (shape["length"], shape["width"]) == (pytest.approx(0.8, abs=0.04), pytest.approx(0.4, abs=0.04))
    assert shape["yaw"] == pytest.approx(2.0 - 0.5 * math.pi, abs=0.1)
    assert np.all(tried.outlines[:, 2] >= tried.outlines[:, 3])
    assert np.all(np.abs(tried.outlines[:, 4]) <= 0.5 * math.pi)


def test_outlines_that_other_recordings_are_asked_about_differ_from_the_fitted_one_and_from_each_other():
    """Best first, none far below the best, and none of those about the one that was fitted."""
    middles = np.array([[0.0, 0.0], [0.01, 0.0], [0.3, 0.0], [0.31, 0.0], [0.6, 0.0], [0.9, 0.0]])
    outlines = np.column_stack([middles, np.full((6, 2), 0.5), np.zeros(6), np.ones(6)])
    tried = Outlines(outlines, np.array([-1.0, -2.0, -3.0, -2.5, -9.0, -30.0]), np.ones((6, 1)))
    found = tried.apart(dict(zip(OUTLINE, outlines[0], strict=True)), 10.0)
    assert [shape["x"] for shape in found] == [0.31, 0.6]
    assert set(found[0]) == set(OUTLINE)
    row = np.repeat(outlines[:1], 40, axis=0) + np.arange(40)[:, None] * np.eye(6)[0]
    many = Outlines(row, -np.ones(40), np.ones((40, 1)))
    assert len(many.apart(dict(zip(OUTLINE, outlines[0], strict=True)), 10.0)) == OTHERS


def test_only_patches_have_an_outline():
    """A push has a start and a duration."""
    assert has_outline(shaped(DISC))
    assert not has_outline(Instance(0, (("duration", 0.2), ("start", 3.0)), (0,)))
    assert not has_outline(Instance(0, (), (0,)))
