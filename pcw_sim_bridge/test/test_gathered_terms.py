"""Terms of one effect on single casters are offered together for one on all of them, and two look-alikes for one."""

from types import SimpleNamespace

import numpy as np
import pytest

from pcw_description import load_robot
from pcw_description.effect_instance import EffectInstance
from pcw_description.robot_description import AXIS_NAMES
from pcw_sim_bridge.mismatch.challenge.simulated_case import Run, World, simulate
from pcw_sim_bridge.mismatch.regression.regression_problem import LinearParameter, Term
from pcw_sim_bridge.mismatch.regression.whitened_regression import Instance
from pcw_sim_bridge.mismatch.robot.robot_channels import RobotProblemBuilder
from pcw_sim_bridge.mismatch.search.evidence_selection import EffectSearch
from pcw_sim_bridge.mismatch.search.gathered_terms import gatherings

ALL = ("a", "b", "c")
SIZE = LinearParameter("size", "N m", 0.0, 1.0, 1.0)


def term(effect, target, axis=None, resolution=()):
    shapes = {name: ("linear", 0.1) for name in resolution}
    return Term(effect, target, (SIZE,), ({},), lambda shape: np.zeros((1, 1, 1)), axis=axis, resolution=shapes)


TERMS = [
    term("actuator_lag", ("a",), "steer"), term("actuator_lag", ("b",), "steer"), term("actuator_lag", ALL, "steer"),
    term("actuator_delay", ALL, "steer"), term("actuator_delay", ALL, "drive"), term("actuator_delay", ("a",), "steer"),
    term("payload_mass", ("chassis",)), term("actuator_lag", ("c",), "drive"),
    term("payload_offset", ("chassis",)), term("payload_mass", ("chassis",), None, ("x", "y")),
]  # fmt: skip


def offered(*chosen):
    problem = SimpleNamespace(terms=TERMS)
    return [
        ([i.term for i in others], wider) for others, wider in gatherings(problem, [Instance(k, (), (0,)) for k in chosen])
    ]


def test_lags_of_two_steerings_may_be_a_lag_or_a_delay_of_all_steerings():
    assert offered(0, 6, 1) == [([6], [2, 3])]


def test_one_alone_is_not_gathered_nor_are_different_axes():
    assert offered(0, 6) == offered(0, 7) == []


def test_what_is_on_all_already_may_still_be_a_look_alike():
    assert offered(2, 0) == [([], [3])]


def test_a_payload_at_the_wrong_place_and_what_makes_up_for_it_may_be_one_payload():
    """Its place is searched; without that, either says what the other cannot."""
    assert offered(8, 9) == [([], [9])]
    assert offered(8, 6) == []


@pytest.mark.parametrize(
    ("radii", "found"),
    [((7.6e-3,) * 4, 1), pytest.param((7.6e-3, 5.0e-3, 7.6e-3, 7.6e-3), 4, marks=pytest.mark.nightly)],
)
def test_casters_that_scrub_alike_are_one_fault_of_all_also_where_each_was_found_exactly(radii, found):
    """From where the problem is exact with four of them, one on all in their place explains nothing to first order."""
    robot = load_robot("dyros_pcv")
    effects = [
        EffectInstance("scrub_torque", (name,), {"radius": radius})
        for name, radius in zip(robot.caster_names, radii, strict=True)
    ]
    recording = simulate(World(robot, robot, "reduced"), Run("run", "random_goals", 20.0, 3), effects)
    problem = RobotProblemBuilder(robot, [recording]).build()
    single = [k for k, term in enumerate(problem.terms) if term.effect == "scrub_torque" and len(term.target) == 1]
    search = EffectSearch(problem, np.random.default_rng(0))
    threshold = search.settings.smallest_threshold
    each = search.settle_on(search.conclude([Instance(k, (), (0,)) for k in single], threshold), threshold)
    assert len(each.fit.instances) == robot.n
    assert len(search.gathered(each).fit.instances) == found


@pytest.mark.parametrize(
    ("loaded", "displaced"), [pytest.param(True, False, marks=pytest.mark.nightly), (True, True), (False, False)]
)
def test_weak_drives_and_steerings_are_a_payload_unless_the_recording_objects(loaded, displaced):
    """Torques too small by one factor are masses too large by it; two effects with strained numbers may fit better.

    A displaced centre of mass beside them is that of the payload: left there, it put the payload where nobody carries one.
    """
    robot = load_robot("thesis")
    effects = [EffectInstance("payload_mass", ("chassis",), {"mass": 18.0, "x": -0.15, "y": -0.01, "z": 0.5})]
    if not loaded:
        effects = [EffectInstance("torque_constant_error", robot.caster_names, {"error": -0.2}, axis) for axis in AXIS_NAMES]
    recording = simulate(World(robot, robot, "reduced"), Run("run", "identification", 12.0, 3), effects)
    problem = RobotProblemBuilder(robot, [recording]).build()
    weak = [
        k for k, term in enumerate(problem.terms)
        if term.effect == "torque_constant_error" and len(term.target) == robot.n
    ]  # fmt: skip
    chosen = [Instance(k, (), (0,)) for k in weak]
    if displaced:
        [offset] = [k for k, term in enumerate(problem.terms) if term.effect == "payload_offset"]
        chosen.append(Instance(offset, tuple(sorted(problem.terms[offset].shapes[0].items())), (0, 1)))
    search = EffectSearch(problem, np.random.default_rng(0))
    threshold = search.settings.smallest_threshold
    both = search.conclude(search.made_exact(tuple(chosen)), threshold)
    assert len(both.fit.instances) == len(chosen)
    found = search.with_one_cause(both)
    names = [problem.terms[instance.term].effect for instance in found.fit.instances]
    assert names == (["payload_mass"] if loaded else ["torque_constant_error"] * 2)
    if loaded:
        assert found.fit.mean[-1] == pytest.approx(18.0, rel=0.05)
        place = dict(found.fit.instances[0].shape)
        assert np.hypot(place["x"] + 0.15, place["y"] + 0.01) < 0.02


@pytest.mark.parametrize("loaded", [True, pytest.param(False, marks=pytest.mark.nightly)])
def test_weak_steerings_are_strong_drives_and_a_payload_where_inertias_say_so(loaded):
    """A payload hid behind motors that were stronger by as much: named was the one effect that turns all of that round."""
    robot = load_robot("thesis")
    effects = [EffectInstance("torque_constant_error", robot.caster_names, {"error": -0.3}, "steer")]
    if loaded:
        effects = [
            EffectInstance("torque_constant_error", robot.caster_names, {"error": 0.45}, "drive"),
            EffectInstance("payload_mass", ("chassis",), {"mass": 0.5 * robot.total_mass, "x": 0.04, "y": -0.09, "z": 0.3}),
        ]
    recording = simulate(World(robot, robot, "reduced"), Run("run", "identification", 12.0, 3), effects)
    problem = RobotProblemBuilder(robot, [recording]).build()
    [steer] = [
        k for k, term in enumerate(problem.terms)
        if (term.effect, term.axis) == ("torque_constant_error", "steer") and len(term.target) == robot.n
    ]  # fmt: skip
    search = EffectSearch(problem, np.random.default_rng(0))
    threshold = search.settings.smallest_threshold
    one = search.conclude(search.made_exact((Instance(steer, (), (0,)),)), threshold)
    found = search.with_other_axis(one)
    named = [(problem.terms[instance.term].effect, problem.terms[instance.term].axis) for instance in found.fit.instances]
    if not loaded:
        assert named == [("torque_constant_error", "steer")]
        return
    assert named == [("torque_constant_error", "drive"), ("payload_mass", None)]
    assert found.fit.mean[-2:] == pytest.approx([0.45, 0.5 * robot.total_mass], rel=0.1)


@pytest.mark.parametrize("by_load", [True, pytest.param(False, marks=pytest.mark.nightly)])
def test_a_friction_and_a_resistance_at_one_wheel_are_a_resistance_at_all_of_them_unless_the_recording_objects(by_load):
    """From where both are named neither gives way to one more: what tells them apart, the load, was judged beside them."""
    robot = load_robot("thesis")
    first = robot.caster_names[0]
    effects = [EffectInstance("rolling_resistance", robot.caster_names, {"arm": 5e-4})]
    if not by_load:
        effects = [
            EffectInstance("drive_coulomb_friction", robot.caster_names, {"coulomb": 0.14}),
            EffectInstance("rolling_resistance", (first,), {"arm": 3e-4}),
        ]
    recording = simulate(World(robot, robot, "reduced"), Run("run", "identification", 12.0, 3), effects)
    problem = RobotProblemBuilder(robot, [recording]).build()
    wanted = [("drive_coulomb_friction", robot.caster_names), ("rolling_resistance", (first,))]
    instances = [Instance(k, (), (0,)) for k, term in enumerate(problem.terms) if (term.effect, term.target) in wanted]
    search = EffectSearch(problem, np.random.default_rng(0))
    both = search.conclude(search.made_exact(tuple(instances)), search.settings.smallest_threshold)
    found = search.with_one_look_alike(both)
    named = [(problem.terms[instance.term].effect, problem.terms[instance.term].target) for instance in found.fit.instances]
    if by_load:
        assert named == [("rolling_resistance", robot.caster_names)]
    else:
        assert sorted(named) == wanted
