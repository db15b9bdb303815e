"""Encoders and IMU together: laws of the filter, Fig. 4.2, odometry over slippery patches, and one without the other."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pcw_description import inverse_kinematics, load_robot
from pcw_estimation import EstimationError, ImuSlip, ImuSlipParameters, Verdict
from pcw_estimation.imu_slip import covariance_of
from pcw_estimation.studies.drawn_drives import STEP, DriveStyle, drawn_robot, drawn_twist, drive
from pcw_estimation.studies.encoder_study import with_imu_at_1_khz
from pcw_estimation.studies.imu_study import all_wheels_slip, follow, found_after, hundred_metres
from pcw_estimation.studies.slip_study import nees_bounds

THESIS = with_imu_at_1_khz(load_robot("thesis"))
RX, RY = THESIS.sensors.imu.position[:2]


def rolling(twist, steer_angle=(0.0, 0.0, 0.0, 0.0)):
    position = np.zeros((4, 2))
    position[:, 1] = steer_angle
    return position, inverse_kinematics(THESIS, position[:, 1].copy(), np.array(twist, dtype=float))


class Driver:
    """A filter that is fed by a robot that rolls with constant headings, at 500 Hz and 1 kHz."""

    def __init__(self, parameters=None):
        self.filter = ImuSlip(THESIS, parameters=parameters)
        self.state, self.position, self.count = self.filter.initial_state(), np.zeros((4, 2)), 0

    def run(self, duration, speed, imu_speed=None, imu=True, acceleration=0.0, gyro=0.0):
        """Drive straight on; `imu_speed` is the true speed where the wheels slip."""
        motion = None
        for _ in range(round(duration / 0.002)):
            velocity = rolling((speed, 0.0, 0.0))[1]
            self.position = self.position + 0.002 * velocity
            if imu and self.count:
                for _ in range(2):
                    self.state = self.filter.predict(self.state, gyro, acceleration, 0.0, 0.001)
            elif self.count:
                pass
            ahead = 0.0 if imu else 0.002
            self.state, motion = self.filter.correct(
                self.state, self.position, velocity, 0.002 if self.count else 0.0, ahead if self.count else 0.0
            )
            self.count += 1
        return motion


def test_standstill_teaches_the_biases():
    driver = Driver()
    motion = driver.run(3.0, 0.0, gyro=0.0013, acceleration=0.04)
    assert motion.gyro_bias == pytest.approx(0.0013, abs=1e-5)
    assert np.abs(motion.pose).max() < 1e-3
    # Bias and slope of the floor look alike at standstill; their sum is what is known.
    assert driver.state[6] + driver.state[8] == pytest.approx(0.04, rel=0.05)
    assert motion.finding.verdict is Verdict.CONSISTENT and motion.inertial and not motion.all_slip


def test_all_wheels_that_spin_are_not_followed():
    driver = Driver()
    driver.run(1.0, 0.0)
    for k in range(250):  # up to 0.5 m/s in half a second, wheels and IMU alike
        driver.run(0.002, 0.002 * (k + 1), acceleration=1.0)
    assert driver.run(0.5, 0.5).finding.twist[0] == pytest.approx(0.5, abs=2e-3)
    motion = driver.run(0.5, 0.8)
    assert motion.all_slip and motion.finding.slipping[:, 0].all()
    assert motion.finding.twist[0] == pytest.approx(0.5, abs=0.01)
    assert motion.finding.slip[:, 0] == pytest.approx(0.3, abs=0.01)
    motion = driver.run(0.1, 0.5)
    assert not motion.all_slip and motion.finding.verdict is Verdict.CONSISTENT


def test_wheels_that_agree_for_long_are_believed():
    """A ramp: gravity says that the robot brakes, and all wheels say that it does not."""
    driver = Driver(ImuSlipParameters(yield_time=1.0))
    driver.run(1.0, 0.0)
    for k in range(250):
        driver.run(0.002, 0.002 * (k + 1), acceleration=1.0)
    assert driver.run(0.5, 0.5, acceleration=-0.6).all_slip
    motion = driver.run(2.5, 0.5, acceleration=-0.6)
    assert not motion.all_slip and motion.finding.verdict is Verdict.CONSISTENT
    assert motion.finding.twist[0] == pytest.approx(0.5, abs=5e-3)


def test_without_an_imu_the_wheels_carry_on():
    driver = Driver()
    motion = driver.run(2.0, 0.4, imu=False)
    assert not motion.inertial
    np.testing.assert_allclose(motion.finding.twist, [0.4, 0.0, 0.0], atol=1e-6)
    assert motion.pose[0] == pytest.approx(0.8, abs=0.01)
    assert 0.0 < motion.pose_covariance[0, 0] < 1e-3 and motion.pose_covariance[2, 2] > 0.0
    motion = driver.run(1.0, 0.4)  # and an IMU that comes late is taken up
    assert motion.inertial


def test_one_wheel_is_named_with_and_without_an_imu():
    for imu in (True, False):
        driver = Driver()
        driver.run(0.5, 0.0, imu=imu)
        velocity = np.zeros((4, 2))
        velocity[3, 0] = 3.0
        for _ in range(20):
            driver.position = driver.position + 0.002 * velocity
            if imu:
                driver.state = driver.filter.predict(driver.state, 0.0, 0.0, 0.0, 0.002)
            driver.state, motion = driver.filter.correct(
                driver.state, driver.position, velocity, 0.002, 0.0 if imu else 0.002
            )
        assert np.argwhere(motion.finding.slipping).tolist() == [[3, 0]]
        assert np.abs(motion.finding.twist).max() < 1e-3


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_covariance_stays_symmetric_and_positive(seed):
    rng = np.random.default_rng(seed)
    robot = drawn_robot(rng, int(rng.integers(2, 7)))
    twist = drawn_twist(rng, 1.5, DriveStyle(rest=0.1))
    slip = rng.normal(0.0, 0.3, (1, robot.n, 2)) * (np.sin(9.0 * STEP * np.arange(len(twist))) > 0.5)[:, None, None]
    driven = drive(robot, twist, slip, rng)
    slip_filter = ImuSlip(robot)
    state = slip_filter.initial_state()
    for k in range(len(driven.stamp)):
        for sample in range(max(2 * k - 1, 0), 2 * k + 1):
            state = slip_filter.predict(state, driven.gyro[sample], *driven.accelerometer[sample], STEP)
        state, motion = slip_filter.correct(state, driven.position[k], driven.velocity[k], 0.002 if k else 0.0)
        assert np.isfinite(motion.finding.twist).all() and np.isfinite(motion.pose).all()
    covariance = covariance_of(state)
    np.testing.assert_array_equal(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance).min() > -1e-12


def test_lever_arm_does_not_look_like_slip():
    """The robot spins about its own centre: the IMU, 5 cm off it, is accelerated and nothing slips."""
    rng = np.random.default_rng(8)
    steps = 4000
    twist = np.zeros((steps, 3))
    twist[:, 2] = 1.5 * np.clip((STEP * np.arange(steps) - 1.0) / 0.5, 0.0, 1.0)
    driven = drive(THESIS, twist, np.zeros((steps, 4, 2)), rng)
    followed = follow(driven)
    assert not followed.flagged.any()
    assert np.abs(followed.pose[-1, :2]).max() < 0.02
    assert followed.pose[-1, 2] == pytest.approx(driven.pose[-1, 2], rel=0.02)


def test_fig_4_2_all_wheels_are_found_to_slip_within_50_ms():
    """The bar of 98 % on the 200 drives of the study, on the first 40 of other seeds."""
    delays = np.array([found_after(all_wheels_slip(seed)) for seed in range(9000, 9040)])
    assert np.mean((delays >= 0.0) & (delays <= 0.05)) >= 0.98
    assert (delays >= 0.0).all()


@pytest.mark.nightly
def test_odometry_over_slippery_patches():
    """The ratio of the study, on shorter drives of other seeds; and the covariance is not too small.

    The mean NEES has its two-sided bar in the study, on 100 m: on short drives the covariance is somewhat too large.
    """
    drives = [hundred_metres(seed, 40.0) for seed in range(6000, 6012)]
    assert np.median([d.fused for d in drives]) <= 0.25 * np.median([d.plain for d in drives])
    # Of 12 right ones more than 2 lie above the 95 % point of chi squared with 3 degrees of freedom in 2 % of all cases.
    assert sum(d.nees > 7.81 for d in drives) <= 2
    assert np.mean([d.nees for d in drives]) <= nees_bounds(len(drives))[1]


def test_a_gap_keeps_the_pose_and_says_what_is_not_known():
    driver = Driver()
    before = driver.run(1.0, 0.0)
    before = driver.run(1.0, 0.3, imu=False)
    after = driver.filter.interrupted(driver.state, 2.0)
    np.testing.assert_array_equal(after[:3], before.pose)
    assert math.sqrt(covariance_of(after)[0, 0]) == pytest.approx(0.6, rel=0.05)
    assert covariance_of(after)[3, 3] == 1.0
    driver.state = after
    assert driver.run(0.1, 0.3).finding.twist[0] == pytest.approx(0.3, abs=1e-3)


def test_refuses_what_it_cannot_use():
    slip_filter = ImuSlip(THESIS)
    state = slip_filter.initial_state()
    position, velocity = rolling((0.0, 0.0, 0.0))
    with pytest.raises(EstimationError, match="dt = 0.0"):
        slip_filter.predict(state, 0.0, 0.0, 0.0, 0.0)
    with pytest.raises(EstimationError, match="gyro, acceleration = nan"):
        slip_filter.predict(state, math.nan, 0.0, 0.0, 0.001)
    with pytest.raises(EstimationError, match="joint_position"):
        slip_filter.correct(state, position * math.nan, velocity, 0.0)
    with pytest.raises(EstimationError, match="ahead = -1.0"):
        slip_filter.correct(state, position, velocity, 0.0, -1.0)
    with pytest.raises(EstimationError, match="yield_time = 0.0 is not allowed; allowed: a positive number"):
        ImuSlipParameters(yield_time=0.0)
    with pytest.raises(EstimationError, match="slope = -1.0"):
        ImuSlipParameters(slope=-1.0)
