"""Cases of the challenge: which there are, what each conceals, and its answer.

An answer is a mapping that goes into the sealed file as JSON; it alone is enough to record the case. `Answer` has its keys.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from pcw_control.errors import ControlError
from pcw_control.excitation import make_excitation
from pcw_description.effect_instance import EffectInstance
from pcw_description.effects.kinds import ContactEffect
from pcw_description.effects.registry import all_effects
from pcw_description.errors import PcwError
from pcw_description.robot_description import RobotDescription
from pcw_description.robot_file import parse_robot, robot_to_mapping

from ...plants.plant import PLANT_NAMES
from ..errors import MismatchError
from .concealed_effects import (
    CANCELLING,
    HIDDEN_BY_CONTROL,
    NEEDS_IMU,
    NEEDS_TORQUE_COMMANDS,
    RECIPES,
    SILENT_IN,
    Draft,
    Scene,
    draw_effect,
    first_on_patch,
)
from .effect_size import EffectSize, HealthyChannels
from .healthy_deviations import (
    draw_deviations,
    effect_instance,
    healthy_numbers,
    tuned_within,
    with_deviations,
)
from .outside_effects import OUTSIDE_EFFECTS
from .random_robots import draw_robot
from .simulated_case import Run, SimulatedRecording, World, simulate

KINDS: Mapping[str, float] = {"none": 0.38, "single": 0.30, "pair": 0.08, "outside": 0.10, "masked": 0.14}
MASKINGS = ("retuned", "closed_loop", "cancelling", "absent")
PLANT_SHARES: Mapping[str, float] = {"reduced": 0.4, "pybullet": 0.3, "mujoco": 0.3}
EXCITATION_SHARES: Mapping[str, float] = {
    "identification": 0.45, "chirps": 0.2, "random_goals": 0.15, "steps": 0.1, "figure8": 0.05, "strafe": 0.05,
}
# A part of these kinds is what users record: one plain manoeuvre, driven by the velocity loops of the drives. It says little
# of what the robot did not do.
PLAIN_KINDS, PLAIN_SHARE = ("none", "single"), 0.3
PLAIN_EXCITATIONS = ("chirp_x", "chirp_y", "chirp_yaw", "circle", "creep", "figure8", "spin", "steps", "strafe")
DURATIONS = (30.0, 60.0)  # [s]
SHORTEST_RUN, LONGEST_RUN = 15.0, 600.0  # [s]
HOLDOUT_SHARE = 0.7  # the held-out recording may be shorter: it only tests
# The detection floor of the proof: a change of some channel by so many times its noise floor ...
LEAST_SIZE = 3.0
# ... and larger than a healthy robot explains: re-tuning it away takes 6 standard deviations of the tolerances at least, each
# effect by itself, of two that cancel too.
LEAST_EVIDENCE = 18.0  # [nats]
# Magnitudes are drawn log-uniform; one that turns out below the floor, or above the largest strength, is scaled to a strength
# drawn log-uniform between these, in multiples of the floor.
STRENGTHS = (1.1, 20.0)
LARGEST_STRENGTH = 30.0
SHARE_OF_TWO_RECORDINGS = 0.25
# Tyres softer along, in a description in which all are softer, are stiffer across: that would be another answer, and as right.
NOT_HIDDEN_BY: Mapping[str, tuple[str, ...]] = {
    "tyre_longitudinal_stiffness": ("contact.stiffness",), "tyre_lateral_stiffness": ("contact.stiffness",),
}  # fmt: skip
NOISE_RANGE = (0.5, 2.5)
PROBES = 6
# Draws of a case: one whose effects stay below the floor is drawn anew; of so many draws, the one that shows most is kept.
# Where a motion takes casters straight back, next to nothing decides which way each turns: such draws fail, and some other
# motion is found yet.
ATTEMPTS, MOST_ATTEMPTS = 6, 40

Answer = Mapping[str, Any]
"""Of one case. `case`, `kind`, `masking` (or null), `plant`, `controller`, `robot` (name), `noise` (factor on the sensors'),
`nominal` and `true` (robot files as mappings), `deviations` and `retuned` (by name, see healthy_deviations),
`runs` (fields of `Run`; those below `holdout` are held out), and `effects`: `name`, `target`, `axis`, `parameters`, `outside`,
`size`, `channel`, `evidence`, `region` (see effect_size), `onset` [s] or null, `place` {x, y, radius} [m] or null."""


@dataclasses.dataclass(frozen=True)
class CaseOrder:
    """What is fixed of a case before anything is drawn for it.

    Attributes:
        effects: names of the effects to conceal; of a cancelling pair its position in `CANCELLING`.
    """

    name: str
    kind: str
    masking: str | None
    effects: tuple[str, ...]
    plant: str
    seed: tuple[int, int]
    durations: tuple[float, float]


def order_cases(
    count: int,
    seed: int,
    kinds: Sequence[str] = tuple(KINDS),
    plants: Sequence[str] = PLANT_NAMES,
    durations: tuple[float, float] = DURATIONS,
) -> list[CaseOrder]:
    """Decide how many cases of each kind there are, in which plant, and which effect comes where.

    Every effect comes as often as any other, give or take one.

    Raises:
        MismatchError: an unknown kind or plant, or no case.
    """
    _check_names("--kinds", kinds, KINDS)
    _check_names("--plants", plants, PLANT_SHARES)
    for option, value, least in (("--cases", count, 1), ("--seed", seed, 0)):
        if value < least:
            raise MismatchError(f"{option} {value} is not allowed; allowed: {least} and more")
    if not SHORTEST_RUN <= durations[0] <= durations[1] <= LONGEST_RUN:
        allowed = f"allowed: {SHORTEST_RUN:g} to {LONGEST_RUN:g} s, the shorter first"
        raise MismatchError(f"--durations {durations[0]:g} {durations[1]:g} is not allowed; {allowed}")
    rng = np.random.default_rng([seed, count])
    drawn_kinds = _shared({kind: KINDS[kind] for kind in kinds}, count, rng)
    drawn_plants = _shared({plant: PLANT_SHARES[plant] for plant in plants}, count, rng)
    known = [name for name in RECIPES if name in all_effects()]
    decks = {
        "single": _deck(known, rng), "pair": _deck(known, rng), "outside": _deck(list(OUTSIDE_EFFECTS), rng),
        "retuned": _deck(known, rng), "closed_loop": _deck(list(HIDDEN_BY_CONTROL), rng),
        "cancelling": _deck([str(k) for k in range(len(CANCELLING))], rng), "absent": _deck(list(SILENT_IN), rng),
        "masking": _deck(list(MASKINGS), rng),
    }
    orders = []
    for index, (kind, plant) in enumerate(zip(drawn_kinds, drawn_plants, strict=True)):
        masking = decks["masking"]() if kind == "masked" else None
        effects: tuple[str, ...] = ()
        if kind != "none":
            effects = (decks[masking or kind](),)
        while kind == "pair" and len(effects) < 2:
            effects = tuple(dict.fromkeys((*effects, decks["pair"]())))
        name = f"case_{index + 1:04d}"
        orders.append(CaseOrder(name, kind, masking, effects, plant, (seed, index), durations))
    return orders


def _check_names(option: str, names: Sequence[str], known: Mapping[str, float]) -> None:
    for name in names:
        if name not in known:
            raise MismatchError(f"{option} {name!r} is not allowed; allowed: {', '.join(known)}")
    if not names:
        raise MismatchError(f"{option} is empty; allowed: some of {', '.join(known)}")


def _shared(shares: Mapping[str, float], count: int, rng: np.random.Generator) -> list[str]:
    """Return `count` names in random order, as many of each as its share says (largest remainders)."""
    total = sum(shares.values())
    exact = {name: count * share / total for name, share in shares.items()}
    whole = {name: math.floor(value) for name, value in exact.items()}
    by_remainder = sorted(exact, key=lambda name: whole[name] - exact[name])
    for name in by_remainder[: count - sum(whole.values())]:
        whole[name] += 1
    names = [name for name, number in whole.items() for _ in range(number)]
    return [names[k] for k in rng.permutation(count)]


def _deck(names: Sequence[str], rng: np.random.Generator) -> Callable[[], str]:
    """Return a function that deals the names, all of them before any comes again."""
    left: list[str] = []

    def deal() -> str:
        if not left:
            left.extend(names[k] for k in rng.permutation(len(names)))
        return left.pop()

    return deal


def prepare_case(order: CaseOrder) -> Answer:
    """Draw a case and measure what it conceals; draws anew where a robot cannot be simulated so, or shows too little.

    Raises:
        MismatchError: no draw could be simulated.
    """
    failures: list[str] = []
    faint: Answer | None = None
    for attempt in range(MOST_ATTEMPTS):
        if faint is not None and attempt >= ATTEMPTS:
            break
        try:
            answer = _Drawing(order, np.random.default_rng([*order.seed, attempt])).answer()
        except PcwError as error:
            failures.append(str(error))
            continue
        if _weakest(answer) >= 1.0:
            return answer
        faint = answer if faint is None else max(faint, answer, key=_weakest)
    if faint is None:
        raise MismatchError(f"{order.name}: no draw could be simulated; the last failed with: {failures[-1]}")
    return faint


def _weakest(answer: Answer) -> float:
    """The least strength of the effects of a case; infinite where there is none."""
    return min((_strength(e["size"], e["evidence"]) for e in answer["effects"]), default=math.inf)


class _Drawing:
    """One attempt at a case."""

    def __init__(self, order: CaseOrder, rng: np.random.Generator) -> None:
        self._order, self._rng = order, rng
        self._base = draw_robot(rng, needs_imu=bool(NEEDS_IMU & set(order.effects)))
        self._noise = _log_uniform(rng, *NOISE_RANGE)
        self._deviations = draw_deviations(self._base, rng)
        self._plain = order.kind in PLAIN_KINDS and rng.random() < PLAIN_SHARE
        by_speeds = (self._plain or order.masking == "closed_loop") and not NEEDS_TORQUE_COMMANDS & set(order.effects)
        controller = "velocity_loops" if by_speeds else "computed_torque"
        true = _noisy(with_deviations(self._base, self._deviations), self._noise)
        self._world = World(self._base, true, order.plant, controller)
        self._fit = [self._run("recordings/run_1", self._excitation())]
        if order.masking == "absent":
            silent = SILENT_IN[order.effects[0]]
            self._fit.append(self._run("recordings/run_2", silent or self._excitation(), active=silent is not None))
        elif rng.random() < SHARE_OF_TWO_RECORDINGS:
            self._fit.append(self._run("recordings/run_2", self._excitation()))
        self._holdout = self._run("holdout/run_1", "holdout" if rng.random() < 0.7 else "random_goals", shorter=True)
        self._retuned: dict[str, float] = {}
        self._strength = 0.0

    def answer(self) -> Answer:
        """Return the answer of the case."""
        order, effects = self._order, self._effects()
        runs = [*self._fit, self._holdout]
        if order.masking == "absent" and self._rng.random() < 0.5:  # the telling one is not always the first
            first, second = self._fit
            runs = [dataclasses.replace(second, path=first.path), dataclasses.replace(first, path=second.path), self._holdout]
        if order.masking == "absent" and not self._fit[1].active:
            runs[-1] = dataclasses.replace(self._holdout, active=False)  # what came from outside does not come again
        return {
            "case": order.name,
            "kind": order.kind,
            "masking": order.masking,
            "plant": order.plant,
            "controller": self._world.controller,
            "robot": self._base.name,
            "noise": self._noise,
            "effects": effects,
            "deviations": self._deviations,
            "retuned": self._retuned,
            "runs": [dataclasses.asdict(run) for run in runs],
            "nominal": robot_to_mapping(self._world.nominal),
            "true": robot_to_mapping(self._world.true),
        }

    def _run(self, path: str, excitation: str, active: bool = True, shorter: bool = False) -> Run:
        """Draw length and seed of a run; a manoeuvre that the robot cannot finish in that time becomes another."""
        low, high = self._order.durations
        duration = round(float(self._rng.uniform(low, high)) * (HOLDOUT_SHARE if shorter else 1.0), 1)
        seed = int(self._rng.integers(2**31))
        try:
            make_excitation(excitation, self._base, duration, seed)
        except ControlError:
            excitation = "holdout" if shorter else "identification"
        return Run(path, excitation, duration, seed, active)

    def _excitation(self) -> str:
        if self._plain:
            return str(self._rng.choice(PLAIN_EXCITATIONS))
        names = list(EXCITATION_SHARES)
        return str(self._rng.choice(names, p=list(EXCITATION_SHARES.values())))

    def _effects(self) -> list[dict[str, Any]]:
        """Draw the effects, sized to be seen and no larger than sensible."""
        if self._order.kind == "none":
            return []
        run = self._fit[0]
        healthy = simulate(self._world, run, ())
        channels = HealthyChannels(self._world.nominal, [healthy], [simulate(self._world.quiet(), run, ())])
        scene = Scene(self._base, healthy, self._rng)
        cancelling = self._order.masking == "cancelling"
        found = []
        for name in self._order.effects:
            place = self._rng.uniform()  # between the weakest and the strongest
            self._strength = STRENGTHS[0] * (STRENGTHS[1] / STRENGTHS[0]) ** place
            group = self._cancelling(name, scene, place) if cancelling else _alone(draw_effect(name, scene, place))
            instances, size = self._sized(group, run, channels)
            if self._order.masking == "retuned":
                self._retune(size, channels, name)
                runs = [simulate(self._world.quiet(), run, instances)]
                left = channels.evidence(self._world.nominal, runs, instances)
                size = dataclasses.replace(size, evidence=left)
            found += [self._entry(instance, size, healthy) for instance in instances]
        return found

    def _cancelling(self, number: str, scene: Scene, place: float) -> _Group:
        """Two effects whose sizes go together."""
        pair = CANCELLING[int(number)]
        targets: tuple[str, ...]
        if pair.first == pair.second:
            one, other = (str(name) for name in self._rng.choice(scene.robot.caster_names, 2, replace=False))
            first, targets = draw_effect(pair.first, scene, place, (one,)), (other,)
        else:
            targets = tuple(scene.robot.caster_names)
            on_casters = all_effects()[pair.first].target_kind == "caster"
            first = draw_effect(pair.first, scene, place, targets if on_casters else None)

        def both(factor: float) -> list[EffectInstance]:
            made = first.scaled(factor).instance()
            return [made, effect_instance(pair.second, targets, pair.parameters(scene, made.parameters), made.axis)]

        return both

    def _sized(
        self, group: _Group, run: Run, channels: HealthyChannels
    ) -> tuple[list[EffectInstance], EffectSize]:
        """Return the effects of a group at a strength that is seen, or as near as its limits and the robot allow."""
        measured: dict[float, tuple[list[EffectInstance], EffectSize]] = {}

        def strength(factor: float) -> float:
            instances = group(factor)
            size = next((known for at, known in measured.values() if at == instances), None)  # at its limit
            if size is None:
                size = channels.size([simulate(self._world.quiet(), run, instances)], instances)
            measured[factor] = instances, size
            return _strength(size.size, size.evidence)

        factor = find_factor(strength, self._strength)
        if factor is None:
            raise MismatchError(f"{self._order.name}: {self._order.effects} at no size that the robot can be driven with")
        return measured[factor]

    def _retune(self, size: EffectSize, channels: HealthyChannels, effect: str) -> None:
        """Move the numbers of the description to where they hide the effect best; the controller believes them too.

        The robot stays a healthy one but for the effect: a number tuned one way, of a robot that is off the other way, could
        leave both further apart than the description's tolerance, and that would be another answer, and as right.
        """
        nominal = {nuisance.name: nuisance.nominal for nuisance in channels.problem.nuisances}
        for number in healthy_numbers(self._base):
            if number.described and number.name in size.retuned and number.name not in NOT_HIDDEN_BY.get(effect, ()):
                relative = nominal[number.name] if number.name.startswith("rotors") else 1.0
                wanted = float(size.retuned[number.name] / relative)
                self._retuned[number.name] = tuned_within(self._base, number.name, wanted, self._deviations[number.name])
        self._world = dataclasses.replace(self._world, nominal=with_deviations(self._base, self._retuned))

    def _entry(self, instance: EffectInstance, size: EffectSize, healthy: SimulatedRecording) -> dict[str, Any]:
        onset, place = None, None
        values = instance.parameters
        if instance.name == "external_push":
            onset = values["start"]
        elif instance.name == "low_friction_patch":
            onset = first_on_patch(self._base, healthy, values)
            place = {"x": values["x"], "y": values["y"], "radius": 0.5 * max(values["length"], values["width"])}
        return {
            "name": instance.name,
            "target": list(instance.target),
            "axis": instance.axis,
            "parameters": dict(values),
            "outside": instance.name in OUTSIDE_EFFECTS,
            "size": size.size,
            "channel": size.channel,
            "evidence": size.evidence,
            "region": {name: list(span) for name, span in size.region.items()},
            "onset": onset,
            "place": place,
        }


_Group = Callable[[float], list[EffectInstance]]


def _alone(draft: Draft) -> _Group:
    return lambda factor: [draft.scaled(factor).instance()]


def _strength(size: float, evidence: float) -> float:
    """How many times larger than at the detection floor an effect is."""
    return max(min(size / LEAST_SIZE, math.sqrt(evidence / LEAST_EVIDENCE)), 1e-6)


def find_factor(strength: Callable[[float], float], wanted: float) -> float | None:
    """Find the factor at which an effect is above the floor and no stronger than is sensible, or comes nearest to that.

    Args:
        strength: of the effect at a factor, in multiples of the floor; a PcwError where that is too much for the robot.
        wanted: strength to aim at where the first, at a factor of 1, is not sensible.

    Returns:
        One of the factors that were tried; None if all of them were too much.
    """
    found: dict[float, float] = {}  # by how far the strength is not sensible, as a logarithm
    factor, low, high = 1.0, 0.0, math.inf  # what is too faint at `low` is too much at `high`
    for _ in range(PROBES):
        try:
            here = strength(factor)
        except PcwError:
            high, aim = factor, 0.3 * factor
        else:
            found[factor] = max(-math.log(here), math.log(here / LARGEST_STRENGTH), 0.0)
            if found[factor] == 0.0:
                break
            low, high = (factor, high) if here < 1.0 else (low, factor)
            aim = factor * min(max(wanted / here, 0.03), 30.0)
        factor = aim if low < aim < high else math.sqrt(low * high)
    return min(found, key=lambda tried: found[tried], default=None)


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(math.exp(rng.uniform(math.log(low), math.log(high))))


def _noisy(robot: RobotDescription, factor: float) -> RobotDescription:
    """Return the robot with so much more noise in all its sensors; encoders keep their counts."""
    sensors = robot.sensors
    changed: dict[str, Any] = {}
    for part in ("encoders", "imu", "tracker"):
        own = getattr(sensors, part)
        if own is not None:
            noises = {f.name: factor * getattr(own, f.name) for f in dataclasses.fields(own) if f.name.endswith("_noise")}
            changed[part] = dataclasses.replace(own, **noises)
    return dataclasses.replace(robot, sensors=dataclasses.replace(sensors, **changed))


# -- from an answer back to what is simulated ---------------------------------------------------------------------


def world_of(answer: Answer) -> World:
    """Return the world of an answer."""
    return World(parse_robot(answer["nominal"]), parse_robot(answer["true"]), answer["plant"], answer["controller"])


def runs_of(answer: Answer) -> list[Run]:
    """Return the runs of an answer."""
    return [Run(**run) for run in answer["runs"]]


def effects_of(answer: Answer) -> list[EffectInstance]:
    """Return the effects of an answer."""
    return [EffectInstance(e["name"], tuple(e["target"]), e["parameters"], e["axis"]) for e in answer["effects"]]


def is_of_the_floor(name: str) -> bool:
    """Whether an effect stands under the wheels because it lies on the floor, and on no caster."""
    effect = all_effects().get(name)
    return isinstance(effect, ContactEffect) and name in ("low_friction_patch", "uneven_ground")
