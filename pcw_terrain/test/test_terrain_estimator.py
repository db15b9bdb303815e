"""The estimator of one wheel: accuracy, honesty, changes of ground, and everything that can be wrong with its readings."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from pcw_description import load_robot
from pcw_description.contact.contact_model import friction_coefficient, tyre_parameters
from pcw_terrain import (
    TerrainError,
    TerrainEstimator,
    TerrainParameters,
    ThesisRls,
    ThesisRlsParameters,
    WheelReading,
)
from pcw_terrain.friction_shape import shape_at, shape_table
from pcw_terrain.studies import terrain_study
from pcw_terrain.studies.one_wheel_ground import GroundWheel
from pcw_terrain.studies.terrain_study import (
    RATE,
    estimator_of,
    ground,
    held_run,
    pushed_run,
    readings_of,
    swept_run,
    thesis_run,
)
from pcw_terrain.terrain_estimator import (
    BLOCK_TIME_CONSTANTS,
    CHANGES,
    IS_VALID,
    LAMBDA_P,
    LAMBDA_VARIANCE,
    MU_P,
    MU_VARIANCE,
    REASON,
    REASONS,
    WRONG_SIGN,
    block_share,
    block_shares,
    ends_share,
    noise_gain,
)

# Small versions of what `terrain_study` measures with 200 seeds.
SEEDS = range(25)


def constant(rolling=1.0, velocity=0.95, force=60.0, load=200.0):
    return WheelReading(rolling, velocity, force, load)


# --- Accuracy, with the settings of the thesis ------------------------------------------------------------


@pytest.fixture(scope="module")
def thesis_accuracy():
    return terrain_study.accuracy([thesis_run(seed) for seed in SEEDS], (0.8, 0.999))


def test_with_the_settings_of_the_thesis_it_is_accurate(thesis_accuracy):
    """The bar: 2 % and 5 %, median. 25 runs scatter by about a quarter of what is allowed."""
    ours = thesis_accuracy["ours"]
    assert ours.reached >= 15
    assert ours.mu_error < 0.02 and ours.lambda_error < 0.05
    assert abs(ours.mu_bias) < 0.01 and abs(ours.lambda_bias) < 0.02
    # Of some 20 intervals at 95 % one is missed on average, and four by one chance in seventy.
    assert ours.mu_coverage > 0.8 and ours.lambda_coverage > 0.8
    assert ours.valid >= 0.8 * ours.reached


def test_after_short_pushes_intervals_hold():
    """A wheel that coasts has slip by noise alone and no force. Told by that alone, mu_p was next to nothing: slip then cost
    nothing, such blocks had weights a hundred times too large, and drew lambda_p up once the wheel slipped; of the intervals
    that were vouched for, three in four held lambda_p.
    """
    ours = terrain_study.accuracy([pushed_run(seed) for seed in range(1000, 1300)], ())["ours"]
    assert ours.valid >= 130
    # At 90 % to be had, less than 0.85 of so many has one chance in forty.
    assert ours.mu_coverage >= 0.9 and ours.lambda_coverage >= 0.85
    assert ours.mu_error < 0.02 and ours.lambda_error < 0.1


def test_slip_that_passes_the_peak_at_once_belongs_to_its_own_force():
    """Without noise. The slip was taken half a reading after the torque, which is that since the reading before: where a push
    takes the wheel past its peak in a few blocks, two of five intervals missed, and some by ten standard deviations.
    """
    missed, found = 0, 0
    for seed in range(60):
        wheel, run = pushed_run(seed)
        quiet = dataclasses.replace(run, measured_rolling_speed=run.rolling_speed, measured_velocity=run.velocity)
        results = estimator_of(wheel).run(readings_of(wheel, quiet), 1.0 / RATE, 10)
        valid = np.nonzero(results[:, IS_VALID])[0]
        if len(valid):
            first = results[valid[0]]
            found += 1
            missed += bool(abs(math.log(first[LAMBDA_P] / wheel.contact.lambda_p)) > 1.96 * math.sqrt(first[LAMBDA_VARIANCE]))
    assert found >= 40 and missed <= 0.1 * found


def test_the_estimator_of_the_thesis_is_not(thesis_accuracy):
    """Errors in variables: a long memory makes it sure of a wrong answer, a short one makes it follow the noise."""
    for name, found in thesis_accuracy.items():
        if name != "ours":
            assert found.mu_error > 0.05 and found.lambda_error > 0.1


def test_the_estimator_of_the_thesis_is_right_without_noise():
    """That it is biased by the noise and not by a mistake in how it was written down: a slow sweep, no filter to speak of."""
    wheel, run = swept_run(3, (1.5, 1.5))
    rolling, truth = run.rolling_speed, wheel.contact
    exact = np.column_stack([rolling, run.velocity, run.force, np.full(len(rolling), wheel.normal_force)])
    mu_p, lambda_p = ThesisRls(ThesisRlsParameters(0.999, filter_rate=500.0)).run(exact, 1.0 / RATE)
    assert mu_p[-1] == pytest.approx(truth.mu_p, rel=0.1) and lambda_p[-1] == pytest.approx(truth.lambda_p, rel=0.2)


def test_without_noise_it_is_exact():
    """What is left is what the filter and the blocks average away of a moving slip: a tenth of a percent."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        wheel = terrain_study.GroundWheel(contact=ground(rng.uniform(0.1, 1.2), rng.uniform(0.04, 0.3)))
        moments = np.arange(8000) / RATE
        slip = 1.5 * wheel.contact.lambda_p * (0.5 - 0.5 * np.cos(math.tau * 0.8 * moments))
        run = terrain_study.run_wheel(wheel, RATE, 8.0, 1.0, rng, slip=slip, noise=0.0, harmonics=0.0)
        last = estimator_of(wheel).run(readings_of(wheel, run), 1.0 / RATE, 10)[-1]
        assert last[MU_P] == pytest.approx(wheel.contact.mu_p, rel=0.002)
        assert last[LAMBDA_P] == pytest.approx(wheel.contact.lambda_p, rel=0.005)


@pytest.mark.parametrize("seed", [3016, 3022, 3040, 3054])
def test_without_noise_fast_slip_is_still_taken_for_that_of_one_curve(seed):
    """Slip that swings up to twice a second is at another place of the curve at the end of a block than at its beginning."""
    wheel, run = swept_run(seed, (1.0, 2.0))
    quiet = dataclasses.replace(
        run, measured_rolling_speed=run.rolling_speed, measured_velocity=run.velocity,
        measured_torque=wheel.inertia / wheel.radius * np.gradient(run.rolling_speed, 1.0 / RATE) + wheel.radius * run.force,
    )  # fmt: skip
    last = estimator_of(wheel).run(readings_of(wheel, quiet), 1.0 / RATE, 10)[-1]
    assert last[IS_VALID] == 1.0
    assert last[MU_P] == pytest.approx(wheel.contact.mu_p, rel=0.005)
    assert last[LAMBDA_P] == pytest.approx(wheel.contact.lambda_p, rel=0.02)


@pytest.mark.parametrize("rate", [500.0, 2000.0])
def test_the_rate_of_the_readings_does_not_matter(rate, monkeypatch):
    monkeypatch.setattr(terrain_study, "RATE", rate)
    wheel, run = swept_run(2, (1.5, 1.5))
    last = estimator_of(wheel).run(readings_of(wheel, run), 1.0 / rate, 10)[-1]
    for value, variance, truth in (
        (last[MU_P], last[MU_VARIANCE], wheel.contact.mu_p), (last[LAMBDA_P], last[LAMBDA_VARIANCE], wheel.contact.lambda_p),
    ):  # fmt: skip
        assert abs(math.log(value / truth)) < 3.0 * math.sqrt(variance) + 0.005


def test_braking_and_driving_backwards_give_the_same_as_driving():
    """Mirrored in any way, the readings are those of the same ground."""
    wheel, run = swept_run(4, (1.6, 1.6))
    readings = readings_of(wheel, run)
    backwards = readings * np.array([-1.0, -1.0, -1.0, 1.0, 1.0, 1.0])
    forth, back = (estimator_of(wheel).run(values, 1.0 / RATE, 10)[-1] for values in (readings, backwards))
    np.testing.assert_allclose(forth[:IS_VALID], back[:IS_VALID], rtol=1e-9)


@pytest.mark.parametrize("case", [pytest.param("thesis", marks=pytest.mark.nightly), "swept"])
def test_intervals_are_as_wide_as_the_errors(case):
    """Errors over their standard deviations scatter by 1; 150 of them tell that to 6 %. The noise of the wheel's acceleration,
    which cancels from block to block, was once counted as if it did not: 0.6 for mu_p with the settings of the thesis. At low
    speed, where the tyre carries the slip's noise from block to block, the other way: 1.1 for lambda_p.
    """
    over = []
    for seed in range(20_000, 20_200):
        wheel, run = thesis_run(seed) if case == "thesis" else swept_run(seed, (1.0, 2.0))
        last = estimator_of(wheel).run(readings_of(wheel, run), 1.0 / RATE, 10)[-1]
        if last[IS_VALID] and np.abs(run.slip_ratio).max() >= wheel.contact.lambda_p:
            error = np.log([last[MU_P] / wheel.contact.mu_p, last[LAMBDA_P] / wheel.contact.lambda_p])
            over.append(error / np.sqrt([last[MU_VARIANCE], last[LAMBDA_VARIANCE]]))
    assert len(over) > 140
    size = np.sqrt(np.mean(np.square(over), axis=0))
    held = (np.abs(over) < 1.96).mean(axis=0)
    assert (size > 0.75).all() and (size < 1.2).all(), size
    assert (held > 0.9).all() and (held < 0.99).all(), held


# --- Honesty ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", ["encoder", "lasting"])
def test_noise_that_is_not_white_is_measured_where_the_filter_lets_it_pass(noise):
    """Of encoder counts that are differenced, neighbours take back what each other gained; of a bump, they have it, too.

    As white noise the first was three times too large (intervals held in six of ten), and the second a sixth of itself: of 60
    such runs 3 came to an estimate that was vouched for.
    """
    errors, held, valid = [], [], 0
    for seed in range(30):
        wheel, run = swept_run(seed, (1.0, 2.0))
        rng, readings = np.random.default_rng([seed, 62]), readings_of(wheel, run)
        if noise == "encoder":
            step = wheel.radius * math.tau / 4096
            rolled = np.cumsum(run.rolling_speed) / RATE + rng.uniform(0.0, step)
            readings[1:, 0] = np.diff(np.floor(rolled / step)) * step * RATE
            readings[0, 0] = readings[1, 0]
        else:
            kept = math.exp(-1.0 / (0.005 * RATE))
            for column, speed in ((0, run.rolling_speed), (1, run.velocity)):
                lasting = lfilter([math.sqrt(1.0 - kept * kept)], [1.0, -kept], rng.standard_normal(len(speed)))
                readings[:, column] = speed * (1.0 + 0.03 * lasting)
        last = estimator_of(wheel).run(readings, 1.0 / RATE, 10)[-1]
        if np.abs(run.slip_ratio).max() < wheel.contact.lambda_p:
            continue
        valid += bool(last[IS_VALID])
        ground_of = wheel.contact
        for value, variance, truth in ((MU_P, MU_VARIANCE, ground_of.mu_p), (LAMBDA_P, LAMBDA_VARIANCE, ground_of.lambda_p)):
            error = abs(math.log(last[value] / truth))
            errors.append(error / (1.0 if value == LAMBDA_P else 0.4))
            held.append(error <= 1.96 * math.sqrt(last[variance]))
    assert valid >= 0.9 * len(errors) / 2
    assert np.median(errors) < 0.02
    assert np.mean(held) > 0.7


@pytest.mark.parametrize("make", [swept_run, held_run])
def test_below_half_of_the_critical_slip_nothing_is_called_valid(make):
    """The bar is 1 % of runs, so that one of 25 runs may be."""
    assert terrain_study.gated(make(seed, (0.2, 0.5)) for seed in SEEDS) <= 1


@pytest.mark.parametrize("seed", [7083, 7168])
def test_a_critical_slip_as_small_as_the_noise_of_the_slip_is_none_that_was_seen(seed):
    """Gentle slip that noise bends into a curve of its own passed for one, for seconds."""
    wheel, run = swept_run(seed, (0.2, 0.5))
    assert not estimator_of(wheel).run(readings_of(wheel, run), 1.0 / RATE)[:, IS_VALID].any()


def test_changes_of_ground_are_found_and_settled():
    found = terrain_study.change_times(range(50))
    assert found.detected.max() <= 0.3
    assert np.mean(found.settled <= 0.8) >= 0.97
    assert np.mean(found.within <= 0.8) >= 0.99 and (found.within <= found.settled).all()


@pytest.mark.parametrize("seed", [51052, 51097, 51163])
def test_a_new_ground_is_known_soon_under_slip_that_swings_fast(seed):
    """An instrument that lies as far off as the tyre carries noise follows nothing of a slip that swings at 2.9 Hz: the first
    second on a new ground said next to nothing, and the estimate settled after 0.8 to 1.5 s.
    """
    assert terrain_study.change_times(range(seed, seed + 1)).settled.max() <= 0.8


def test_a_suspicion_that_chance_began_carries_nothing_into_the_new_estimate():
    """The sum of residuals of seed 39 leaves zero by chance four blocks before mu falls from 0.8 to 0.2. The new estimate once
    began with them: no curve fitted, nothing became valid, and as only valid estimates were watched the way back to 0.8 was
    never found. Seeds 113, 138 and 171 settled late for the same reason.
    """
    for seed in (39, 138, 171):
        found = terrain_study.change_times(range(seed, seed + 1))
        assert found.detected.max() <= 0.3 and found.settled.max() <= 0.8


@pytest.mark.parametrize("seed", [3053, 7186])
def test_blocks_on_the_steep_part_do_not_pass_for_a_misfit(seed):
    """Where the slip moves fast its instrument may be at the peak while the block is not. Judged by the slope at the
    instrument alone such a block lay far off the curve; the misfit stayed high, and a change took 0.35 s to be noticed.
    """
    assert terrain_study.change_times(range(seed, seed + 1)).detected.max() <= 0.3


def test_what_no_curve_fits_is_given_up():
    """Ground that changes too often to tell apart leaves readings of both; once it stays, it is found."""
    rng, wheel = np.random.default_rng(0), terrain_study.GroundWheel(contact=ground(0.8, 0.12))
    moments = np.arange(9000) / RATE
    mixed = (moments < 4.0) & (np.floor(moments / 0.06) % 2 == 0)
    slip = 0.12 * (1.0 + 0.6 * np.sin(9.0 * moments))
    mu_p = np.where(mixed, 0.8, 0.2)
    run = terrain_study.run_wheel(wheel, RATE, 9.0, 1.5, rng, slip=slip, mu_p=mu_p, harmonics=0.0)
    last = estimator_of(wheel).run(readings_of(wheel, run), 1.0 / RATE, 10)[-1]
    assert last[IS_VALID] and last[MU_P] == pytest.approx(0.2, rel=0.03)


def test_readings_that_say_nothing_do_not_reach_into_those_after():
    """A load below zero marks them. Their slip and force are nonsense here, and the filters remember them for a while."""
    wheel, run = swept_run(2, (1.5, 1.5))
    readings = readings_of(wheel, run)
    nothing = np.floor(np.arange(len(readings)) / 150) % 3 == 0
    readings[nothing, 1] = readings[nothing, 0]
    readings[nothing, 2] *= 0.3
    readings[nothing, 3] *= -1.0
    last = estimator_of(wheel).run(readings, 1.0 / RATE, 10)[-1]
    assert last[IS_VALID]
    assert last[MU_P] == pytest.approx(wheel.contact.mu_p, rel=0.03)
    assert last[LAMBDA_P] == pytest.approx(wheel.contact.lambda_p, rel=0.1)


HELD = {
    "held": lambda time, part: part * np.clip(time - 0.5, 0.0, 1.0) ** 2 * (3.0 - 2.0 * np.clip(time - 0.5, 0.0, 1.0)),
    "on and off": lambda time, part: part * np.clip(4.0 * np.sin(1.6 * time), 0.0, 1.0),
}


@pytest.mark.parametrize("noise", [0.0, 0.1])
@pytest.mark.parametrize("kind", list(HELD))
def test_one_slip_that_is_held_does_not_tell_two_numbers(kind, noise):
    """Slip held below half of lambda_p was lambda_p itself, and mu_p what it held there, to some percent, in one of four."""
    time, wrong = np.arange(round(8.0 * RATE)) / RATE, 0
    for seed in range(40):
        rng = np.random.default_rng([seed, 61])
        wheel = GroundWheel(contact=ground(rng.uniform(0.2, 1.0), rng.uniform(0.06, 0.25)))
        slip = HELD[kind](time, rng.uniform(0.2, 0.5) * wheel.contact.lambda_p)
        run = terrain_study.run_wheel(wheel, RATE, 8.0, rng.uniform(0.3, 2.0), rng, slip=slip, noise=noise)
        wrong += bool(estimator_of(wheel).run(readings_of(wheel, run), 1.0 / RATE, 10)[:, IS_VALID].any())
    assert wrong <= 1


def left_behind(grips: float, duration: float = 8.0) -> tuple[GroundWheel, np.ndarray]:
    """A wheel that slips on mu_p = 0.2 for 4 s and grips from then on, its slip unknown, with that part of its load."""
    time = np.arange(round(duration * RATE)) / RATE
    wheel, rng = GroundWheel(contact=ground(0.2, 0.1)), np.random.default_rng(8)
    slip = np.where(time < 4.0, 0.1 - 0.09 * np.cos(math.tau * time), 0.001)
    run = terrain_study.run_wheel(wheel, RATE, duration, 1.5, rng, slip=slip)
    readings = readings_of(wheel, run)
    readings[time >= 4.0, 2] = grips * wheel.normal_force
    readings[time >= 4.0, 3] *= -1.0
    return wheel, readings


def test_a_ground_that_holds_more_than_its_peak_is_another_one():
    """A wheel that came from ice to good ground and gripped stood on ice for ever, whatever it pushed with."""
    wheel, readings = left_behind(grips=0.3)
    found = estimator_of(wheel).run(readings, 1.0 / RATE)
    before, after = found[round(3.9 * RATE)], found[round(4.5 * RATE)]
    assert before[IS_VALID] and before[MU_P] == pytest.approx(0.2, rel=0.03)
    assert not after[IS_VALID] and after[CHANGES] == before[CHANGES] + 1.0 and after[MU_P] == 0.0


def test_an_estimate_is_kept_but_not_vouched_for_where_nothing_is_felt_for_long():
    wheel, readings = left_behind(grips=0.1)
    found = estimator_of(wheel).run(readings, 1.0 / RATE)
    for way, valid in ((1.0, True), (4.8, True), (5.2, False), (5.9, False)):
        row = found[round((4.0 + way / 1.5) * RATE)]
        assert bool(row[IS_VALID]) is valid
        assert row[MU_P] == pytest.approx(0.2, rel=0.03) and row[CHANGES] == 0.0
    assert "too long a way" in REASONS[int(found[-1, REASON])]
    short = TerrainParameters(contact=wheel.contact, inertia=wheel.inertia / wheel.radius**2, reach=0.5)
    assert not TerrainEstimator(short).run(readings, 1.0 / RATE)[round(4.6 * RATE), IS_VALID]


def test_steady_ground_does_not_change():
    """Two minutes here, and in the study for hours."""
    changes, _ = terrain_study.false_changes(range(4), 30.0)
    assert changes == 0


@pytest.mark.nightly
def test_steady_ground_does_not_change_for_ten_minutes():
    changes, _ = terrain_study.false_changes(range(6), 600.0)
    assert changes == 0


def test_a_straight_line_is_no_curve():
    """A wheel whose friction is proportional to its slip up to the end of the readings has no peak that could be known."""
    estimator, rng = TerrainEstimator(), np.random.default_rng(0)
    moments = np.arange(6000) / RATE
    slip = 0.05 * (0.5 - 0.5 * np.cos(3.0 * moments))
    rolling = np.full(6000, 1.0)
    readings = np.column_stack([rolling, 1.0 - slip, 200.0 * 6.0 * slip, np.full(6000, 200.0), 0.0 * slip, 0.0 * slip])
    readings[:, :2] *= 1.0 + 0.02 * rng.uniform(-1.0, 1.0, (6000, 2))
    assert not estimator.run(readings, 1.0 / RATE)[:, IS_VALID].any()


# --- What can be wrong ------------------------------------------------------------------------------------


def test_a_torque_of_the_wrong_sign_is_told_and_never_valid():
    wheel, run = swept_run(1, (1.5, 1.5))
    readings = readings_of(wheel, run) * np.array([1.0, 1.0, -1.0, 1.0, 1.0, 1.0])
    found = estimator_of(wheel).run(readings, 1.0 / RATE)
    assert not found[:, IS_VALID].any()
    assert found[-1, REASON] == WRONG_SIGN


def test_at_rest_nothing_is_known_and_nothing_is_forgotten():
    wheel, run = swept_run(1, (1.5, 1.5))
    estimator, readings = estimator_of(wheel), readings_of(wheel, run)
    rest = np.tile([0.0, 0.0, 0.0, wheel.normal_force, 0.0, 0.0], (3000, 1))
    noisy = rest + np.random.default_rng(0).normal(0.0, 1e-4, rest.shape)
    assert not estimator.run(noisy, 1.0 / RATE)[:, IS_VALID].any()
    found = estimator.run(np.concatenate([readings, noisy]), 1.0 / RATE)
    assert found[len(readings) - 1, IS_VALID] and found[-1, IS_VALID]
    # The filter's tail is at speed still.
    assert found[-1, MU_P] == pytest.approx(found[len(readings) - 1, MU_P], rel=0.02)


def test_a_motion_that_is_reversed_goes_through_rest():
    wheel, run = swept_run(5, (1.5, 1.5))
    readings = readings_of(wheel, run)
    stop = readings[-1:] * np.linspace(1.0, -1.0, 1000)[:, None]
    stop[:, 3] = wheel.normal_force
    backwards = readings * np.array([-1.0, -1.0, -1.0, 1.0, 1.0, 1.0])
    last = estimator_of(wheel).run(np.concatenate([readings, stop, backwards]), 1.0 / RATE)[-1]
    assert last[IS_VALID] and last[MU_P] == pytest.approx(wheel.contact.mu_p, rel=0.05)


@pytest.mark.parametrize("field", ["rolling_speed", "velocity", "force", "normal_force", "lateral_slip", "lateral_force"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_reading_that_is_not_finite_is_refused_and_changes_nothing(field, value):
    estimator = TerrainEstimator()
    state, _ = estimator.step(estimator.initial_state(), constant(), 0.002)
    before = state.numbers.copy()
    bad = WheelReading(**({"rolling_speed": 1.0, "velocity": 0.9, "force": 1.0, "normal_force": 100.0} | {field: value}))
    with pytest.raises(TerrainError, match="allowed"):
        estimator.step(state, bad, 0.002)
    np.testing.assert_array_equal(state.numbers, before)


@pytest.mark.parametrize("dt", [0.0, -0.001, math.nan, math.inf])
def test_a_step_of_time_that_is_none_is_refused(dt):
    estimator = TerrainEstimator()
    with pytest.raises(TerrainError, match="dt"):
        estimator.step(estimator.initial_state(), constant(), dt)


def test_a_step_does_not_change_the_state_before():
    estimator = TerrainEstimator()
    state, _ = estimator.step(estimator.initial_state(), constant(), 0.002)
    before = state.numbers.copy(), state.sums.copy(), state.history.copy()
    for _ in range(30):
        estimator.step(state, constant(force=90.0), 0.002)
    for now, then in zip((state.numbers, state.sums, state.history), before, strict=True):
        np.testing.assert_array_equal(now, then)


def test_nothing_diverges_whatever_comes():
    """Readings that belong to no wheel: an estimate may be wrong, but it is finite, within what is possible, or not there."""
    rng = np.random.default_rng(0)
    for scale in (1e-6, 1.0, 1e6):
        readings = scale * rng.standard_cauchy((20_000, 6))
        found = TerrainEstimator().run(readings, 0.002)
        assert np.isfinite(found).all()
        valid = found[found[:, IS_VALID] > 0.0]
        assert ((valid[:, MU_P] > 0.02) & (valid[:, MU_P] < 2.0)).all()
        assert ((valid[:, LAMBDA_P] >= 0.01) & (valid[:, LAMBDA_P] <= 0.8)).all()


@settings(max_examples=25, deadline=None)
@given(
    st.lists(st.tuples(*6 * [st.floats(-1e9, 1e9)]), min_size=1, max_size=60), st.floats(1e-6, 10.0),
)  # fmt: skip
def test_finite_readings_never_give_numbers_that_are_not(rows, dt):
    found = TerrainEstimator().run(np.array(rows, dtype=float), dt)
    assert np.isfinite(found).all()


@pytest.mark.parametrize(
    ("field", "value"),
    [("cut_off", 0.0), ("inertia", -1.0), ("memory", 0.0), ("least_speed", math.nan), ("least_slip", 0.3),
     ("slip_spread", 0.0), ("least_blocks", 1), ("slip_accuracy", 2.0), ("reach", 0.0), ("cut_off", "20"), ("reach", None)],
)  # fmt: skip
def test_parameters_that_are_not_allowed_are_named(field, value):
    with pytest.raises(TerrainError, match=field):
        TerrainParameters(**{field: value})
    with pytest.raises(TerrainError, match="forgetting_factor"):
        ThesisRlsParameters(forgetting_factor=1.5)


# --- What it stands on ------------------------------------------------------------------------------------


@pytest.mark.parametrize("dt", [0.0005, 0.002])
def test_noise_that_the_filter_leaves_is_what_it_is_said_to_be(dt):
    """White noise through two poles, one more, and a mean: variances and covariances, as well as 4e5 readings tell them."""
    rng, pole, rate = np.random.default_rng(0), 195.0, 60.0
    x = rng.standard_normal(400_000)
    p, q = math.exp(-pole * dt), math.exp(-rate * dt)
    for share in (1.0 - p, 1.0 - p):
        x = _low_pass(x, share)
    assert x.var() == pytest.approx(noise_gain(pole, dt), rel=0.05)
    length = round(BLOCK_TIME_CONSTANTS / pole / dt)
    for signal, one_more in ((x, math.inf), (_low_pass(x, 1.0 - q), rate)):
        means = signal[: len(signal) // length * length].reshape(-1, length).mean(axis=1)
        time = length * dt
        variance, covariance = (noise_gain(pole, dt) * block_share(pole, one_more, time, apart) for apart in (0.0, time))
        assert means.var() == pytest.approx(variance, rel=0.08)
        assert np.cov(means[1:], means[:-1])[0, 1] == pytest.approx(covariance, abs=0.06 * variance)
        assert covariance > 0.15 * variance


def test_the_noise_of_several_blocks_is_that_of_each_pair():
    shares, pole, time = np.empty(6), 195.0, BLOCK_TIME_CONSTANTS / 195.0
    for rate in (15.0, 80.0, math.inf):
        block_shares(pole, rate, time, shares)
        np.testing.assert_allclose(shares, [block_share(pole, rate, time, m * time) for m in range(6)], atol=1e-12)


def test_what_the_noise_of_an_acceleration_gives_one_block_it_takes_from_its_neighbours():
    """Differences of the ends of blocks: covariances as 4e5 readings tell them, and their sum over all blocks is nothing."""
    rng, pole, dt = np.random.default_rng(0), 195.0, 0.0005
    x = rng.standard_normal(400_000)
    for share in 2 * (1.0 - math.exp(-pole * dt),):
        x = _low_pass(x, share)
    length = round(BLOCK_TIME_CONSTANTS / pole / dt)
    differences = np.diff(x[::length])
    gain = noise_gain(pole, dt)
    for apart in range(4):
        covariance = float(np.mean(differences[apart:] * differences[: len(differences) - apart]))
        assert covariance == pytest.approx(gain * ends_share(apart), abs=0.05 * gain)
    assert ends_share(0) + 2.0 * sum(ends_share(m) for m in range(1, 12)) == pytest.approx(0.0, abs=1e-9)
    assert ends_share(1) < -0.4 * ends_share(0)


def _low_pass(x, share):
    return lfilter([share], [1.0, share - 1.0], x)


@pytest.mark.parametrize("model", ["kiencke", "magic_formula", "burckhardt"])
def test_shapes_are_those_of_the_contact_models(model):
    contact = dataclasses.replace(load_robot("thesis").contact, model=model)
    table, tyre = shape_table(contact), tyre_parameters(contact)
    for x in (-2.0, -0.3, 0.0, 0.1, 0.7, 1.0, 1.5, 6.0):
        g, slope, bend = shape_at(table, x)
        assert g == pytest.approx(friction_coefficient(tyre, x * contact.lambda_p, 0.0)[0] / contact.mu_p, abs=2e-4)
        below, above = shape_at(table, x - 0.01)[0], shape_at(table, x + 0.01)[0]
        assert slope == pytest.approx((above - below) / 0.02, rel=0.03, abs=0.02)
    assert shape_at(table, 1.0)[0] == pytest.approx(1.0, abs=1e-3) and abs(shape_at(table, 1.0)[1]) < 0.02


def test_the_study_writes_its_document_and_figures(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(terrain_study, "false_changes", lambda seeds, duration: (0, duration))
    assert terrain_study.main(["--seeds", "2", "--out", str(tmp_path)]) == 0
    text = (tmp_path / "terrain.md").read_text()
    assert text in capsys.readouterr().out
    for name in ("fig_5_19", "fig_5_20"):
        assert f"({name}.svg)" in text and (tmp_path / f"{name}.svg").exists()
        data = np.genfromtxt(tmp_path / f"{name}.csv", delimiter=",", names=True)
        assert np.isfinite(data["ours"][-1]) and data["ours_low"][-1] < data["ours"][-1] < data["ours_high"][-1]
