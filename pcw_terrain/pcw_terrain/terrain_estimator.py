"""Peak friction and critical slip of the ground under one wheel, while it drives: unbiased, with its uncertainty.

    mu = mu_p g(lambda / lambda_p),     g(x) = 2 x / (1 + x^2) for Kiencke's curve (3.47) [Li2009]

Least squares on (5.14) [Li2009] are biased, as the regressor itself is noisy (see `thesis_rls`). Here

- all signals pass the same filter, two poles, and so does the derivative of the wheel's speed that (3.45) needs;
- the slip is relaxed over the tyre's relaxation length like the force is;
- the filtered signals are sampled so far apart that their noise is nearly independent, as blocks;
- the noise of speeds and torques is measured from second differences, of speeds from those of means over a part of the
  filter's memory, and with it the filtered slip's, s, in lambda_p.
  It bends the curve's mean by g'' s^2 / 2, which is taken off:    g_c = g(x) - g''(x) s^2 / 2;
  The curve's mean is bent as well by slip that moves within the filter's memory, which is put back; what noise alone makes
  it move is less than two blocks' noise, since filter and tyre carry noise from one to the next;
- the equations are solved with an instrument, the mean of the slip two blocks before and after, whose noise is another one
  (further off, once there are many blocks, where the tyre's relaxation carries noise along):

      sum w z (mu_k - mu_p g_c(x_k)) = 0,    sum w a (mu_k - mu_p g_c(x_k)) = 0,    z = g(x_i),  a = -x_i g'(x_i),

  with the effective variance 1/w = s_mu^2 + mu_p^2 s^2 (g'^2 + g''^2 s^2) at the instrument's x_i. Noise of the slip that the
  tyre has carried as far as the instrument (covariance c, in lambda_p^2) is taken off: z g_c - z' g' c for z g_c; a likewise.
  The sums are kept for a grid of lambda_p, so that nothing is linearised and nothing can diverge: mu_p follows from the first
  equation, lambda_p is where the second one holds, nearest to the least weighted error.

The covariance is that of these equations. Noise goes on from block to block: that of the slip with the same sign, and that of
the wheel's acceleration with the opposite one, as what one block gains its neighbour loses, so that next to nothing of it is
left in the sum. Both follow from the measured noise, filter and tyre (`block_shares`, `ends_share`), and so the variance of
sum w z r is sum over k and l of w_k z_k w_l z_l C(k, l), and so on. What residuals are beyond that noise counts with the
correlation that they have. The spread of lambda_p is as wide as the second equation holds within its noise, on its wider side.

An estimate is valid when it is narrow enough, the slip has been beyond `least_slip` of the largest lambda_p that it allows,
and the force acted along the slip and not against it. One slip that is held gives one equation for two numbers, and the second
one has a root wherever a = 0, at lambda_p = slip: what of a is not z has to be more than noise makes of it.

Residuals that add up to a jump mean that the ground changed: the estimate then begins anew from the blocks since. So does a
force that no ground of that mu_p holds, where a wheel grips and its slip is not known; and where nothing is felt for `reach`,
the estimate is kept, but is not vouched for.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pcw_description.compiled import compiled
from pcw_description.contact.contact_model import DAMPING_TIME
from pcw_description.robot_description import ContactDescription, FloatArray

from .errors import TerrainError, require, require_dt
from .friction_shape import shape_at, shape_table

# Bounds of physics: rubber, felt or ice on any floor.
LEAST_FRICTION, GREATEST_FRICTION = 0.02, 2.0
LEAST_CRITICAL_SLIP, GREATEST_CRITICAL_SLIP = 0.01, 0.8
GRID = 64
# A pole of the filter for a cut-off (-3 dB) of two equal ones, and the time between blocks in units of its time constant.
POLE_PER_CUT_OFF, BLOCK_TIME_CONSTANTS = 2.0 * math.pi / math.sqrt(math.sqrt(2.0) - 1.0), 4.0
# Of a mean over a block, relative to the filtered signal: the spread of what moves steadily through filter and block, in units
# of its way from block to block.
BLOCK_SPREAD = 2.0 / BLOCK_TIME_CONSTANTS**2 + 1.0 / 12.0
SPECTRUM_POINTS = 32
# Noise of a block is followed into so many blocks after it: tyres at 0.3 m/s carry a tenth of it as far.
PAIRS = 8
# The instrument is so many blocks older and younger, and by the tyre's relaxation more: once there are many blocks, as further
# off it follows the slip less. Of a few blocks their noise is worth more than what the tyre has carried and is not taken off.
LEAST_LAG, RELAXATION_LAG = 2, 1.0
# Noise below this part of the slip is none.
QUIET_NOISE = 0.05
CORRELATION_SHARE = 0.005
# Readings have to be known for a block and so many more before it, as the filter remembers what came before.
KNOWN_BLOCKS = 1.5
# Noise is averaged over this time [s], and blocks count from when so much of it has passed; that of speeds is taken from means
# over the last of these.
NOISE_MEMORY, NOISE_SETTLED, NOISE_TIME = 0.5, 0.1, 0.004
# Above this part of the critical slip its noise bends the curve's mean in ways that are not corrected for: a lambda_p as small
# as the noise is none that was seen.
GREATEST_NOISE = 0.35
# Blocks at fewer parts of the critical slip than this say little and make older ones forgotten more slowly.
INFORMATIVE_SLIP = 0.3
UNSTEADY_SLIP = 0.25
# Slip and force of a block belong together to this part of what the slip moves by from block to block, without any noise.
MOVING_ACCURACY = 0.15
# Blocks are weighted by the peak friction that those say in which slip and force stand out of their noise by so many standard
# deviations, and by what floors have before there are any. Of a wheel that coasts, noise would say that there is no friction:
# slip would then cost nothing, and such blocks would outweigh those that follow.
FELT_DEVIATIONS, USUAL_FRICTION, USUAL_SPREAD = 3.0, 0.5, 0.25
# The spread of lambda_p is that of this many standard deviations of the second equation, on its wider side.
INTERVAL_DEVIATIONS = 1.96
# Degrees of freedom that the expected size of the residuals counts for, besides those of the residuals.
PRIOR_BLOCKS = 5.0
# Mean squares of residuals that are larger by so many of their standard deviations may be so by chance.
CHANCE = 2.0
# Residuals beyond so many standard deviations count as that many; so much of each is allowed for, and so much must add up.
LARGEST_RESIDUAL, ALLOWED_RESIDUAL, CHANGE_THRESHOLD = 4.0, 1.0, 16.0
# From this sum on nothing more is learned until it is decided; blocks wait in the history, so long.
SUSPENDED, LONGEST_SUSPENSION = 5.0, 10.0
# Curves differ from the model by this part of the friction without being another ground.
CHANGE_FLOOR = 0.05
YOUNG_BLOCKS = 30.0
# How large a jump is, is told by so many of the newest residuals.
JUMP_BLOCKS = 3
# No ground holds more than its peak: so many blocks more above it than not, by this part of it and by so many standard
# deviations, are of another ground, whatever the slip.
ABOVE_PART, ABOVE_DEVIATIONS, ABOVE_BLOCKS = 0.1, 3.0, 5.0
# Forces against the slip by this many standard deviations, in this many blocks more than along it, have the wrong sign.
WRONG_SIGN_DEVIATIONS, WRONG_SIGN_BLOCKS = 3.0, 8.0
# Residuals of this many expected standard deviations say that the curve is another one.
GREATEST_MISFIT = 4.0
# After so many blocks of it what has been learned is given up.
LONGEST_MISFIT = 50.0
# An estimate that is valid stays so up to this many times the spread at which it becomes so.
STAYS_VALID = 1.25
# Spreads of the logarithms of mu_p and lambda_p up to which a reading can be compared with an estimate, valid or not.
COMPARABLE = (0.2, 0.5)
# So many blocks must have slipped beyond `least_slip`: fewer of gentle slip may be noise.
BEYOND_BLOCKS = 5.0
# Two numbers take two slips: what of one instrument is not the other has to be so many times what a slip that is always the
# same makes of it, by its noise and by this part of itself.
VARIED, VARIED_CHANCE, STEADY_PART = 1.4, 3.0, 0.05
# A curve must fit better than a straight line by so much (twice the logarithm of the likelihood).
BENT = 20.0

# Layout of the parameters as the kernels take them.
(
    _CUT_OFF, _RELAXATION, _INERTIA, _LATERAL_MU, _LATERAL_LAMBDA, _SLIP_ACCURACY, _FRICTION_ACCURACY, _MEMORY, _LEAST_SPEED,
    _LEAST_LOAD, _LEAST_SLIP, _SLIP_SPREAD, _FRICTION_SPREAD, _LEAST_BLOCKS, _REACH,
) = range(15)  # fmt: skip
# Layout of the state: two stages of each filtered signal, then the rest.
_ROLLING, _VELOCITY, _FORCE, _SLIP_Y, _FORCE_Y, _LOAD = range(0, 12, 2)
_BEFORE, _NOISE = 12, 21  # the two last means of rolling speed and velocity, the two last forces; variances of a reading
_Z_X, _Z_Y, _TIME, _SINCE_BLOCK, _NOISE_TIME, _READINGS = range(24, 30)
_WEIGHT, _BLOCKS, _CORRELATION, _LAST_RESIDUAL, _UP, _DOWN, _SUSPECT, _WRONG_SIGN = range(30, 38)
_CHANGES, _CHANGE_TIME, _SLIP, _FRICTION, _SLIP_NOISE, _OPENED, _CUMULATED = range(38, 45)
# Sums over the block so far: of rolling speed, velocity, force, force across, load, relaxed slip along and across; time, and
# the rolling speed at its beginning.
_MEAN, _BLOCK_TIME, _BEGAN_AT = 45, 52, 53
_RESULT = 54  # mu_p, lambda_p, variances of their logarithms and covariance, valid, misfit, reason
_HISTORY, _BLOCK = 16, 16  # blocks kept: slip, variance, friction, variance, time, usable, what bends the curve, lag of the
# instrument, whether it has been added, residual in standard deviations; noise of the slip per unit of its gain, rate of the
# tyre's relaxation (0: none), noise of the friction by the wheel's acceleration and by the force, sign of the force; variance
# of the slip without what moves
_KNOWN_FOR, _MISFITS = 62, 63  # time for which every reading has been known [s]; blocks in a row of which none fits
_TAKEN = 64  # blocks taken so far, modulo PAIRS; then time and sign of each of the last ones
_WAY, _ABOVE = _TAKEN + 1 + 2 * PAIRS, _TAKEN + 2 + 2 * PAIRS  # rolled since a block said something [m]; see ABOVE_BLOCKS
_AVERAGE, _AVERAGED, _AVERAGES = _ABOVE + 1, _ABOVE + 3, _ABOVE + 4  # sums of speeds for such a mean, how many, means so far
_SQUARE = _AVERAGES + 1  # means of the squares of both speeds over the time of their noise [m^2/s^2]
_RATIO_X, _RATIO_Y = _SQUARE + 2, _SQUARE + 3  # slip of the reading before, along and across, not relaxed
_STATE = _SQUARE + 4
_PAIRED = 27  # then, of each of the last blocks: both weighted functions, slope and bend of the curve
_SUMS = _PAIRED + 4 * PAIRS
# Columns of what `TerrainEstimator.run` returns.
RESULTS = 14
MU_P, LAMBDA_P, MU_VARIANCE, COVARIANCE, LAMBDA_VARIANCE, IS_VALID, MISFIT, REASON, CHANGES, SLIP = range(10)
FRICTION, SLIP_NOISE, SINCE_CHANGE, SUSPECT = range(10, RESULTS)
(
    _ZZ, _ZA, _AA, _ZY, _ZG, _AY, _AG, _YY, _GY, _GG, _LOG, _BEYOND, _W, _NOISE_ZZ, _NOISE_ZA, _NOISE_AA, _NOISE_SHARE,
    _SLIP_ZZ, _SLIP_ZA, _SLIP_AA, _SLIP_SHARE, _STEADY_ZZ, _STEADY_ZA, _STEADY_AA,
    _FELT_ZZ, _FELT_ZY, _FELT_ZG,
) = range(_PAIRED)  # fmt: skip

# Why an estimate is not valid, or 0.
VALID, TOO_FEW, TOO_LITTLE_SLIP, TOO_WIDE, WRONG_SIGN, NO_FIT, AT_A_BOUND, TOO_FAR = range(8)
REASONS = (
    "valid", "too few readings at speed", "not enough slip to know", "not certain enough yet",
    "forces act against the slip: a torque or a speed has the wrong sign, or the speed is that of an observer which believes "
    "in far better ground",
    "the friction curve does not fit", "at a bound of what is possible", "nothing felt of the ground for too long a way",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class TerrainParameters:
    """How the ground is estimated.

    Attributes:
        contact: whose curve has the shape g, relaxation length and ratios of lateral to longitudinal; None: Kiencke's curve,
            no relaxation, the same in all directions.
        cut_off: of the filter on all signals [Hz].
        inertia: I_rho / r^2, where forces are given as torque over radius (3.45) [kg]; 0 where they are forces.
        slip_accuracy: error of the slip ratio that does not average out [1].
        friction_accuracy: error of force over load that does not average out, relative [1].
        memory: informative time after which readings are forgotten [s].
        least_speed: below it a reading says nothing [m/s].
        least_load: below this normal force a reading says nothing [N].
        least_slip: part of the critical slip that must have been reached [1].
        slip_spread, friction_spread: standard deviations of the logarithms up to which an estimate is valid [1].
        least_blocks: blocks (50 a second) that an estimate takes at least.
        reach: way rolled without a reading that says something, after which an estimate is not vouched for any more [m].
    """

    contact: ContactDescription | None = None
    cut_off: float = 20.0
    inertia: float = 0.0
    slip_accuracy: float = 0.0
    friction_accuracy: float = 0.0
    memory: float = 20.0
    least_speed: float = 0.05
    least_load: float = 1.0
    least_slip: float = 0.6
    slip_spread: float = 0.12
    friction_spread: float = 0.06
    least_blocks: int = 10
    reach: float = 5.0

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            TerrainError: names the field, its value and what is allowed.
        """
        require("cut_off", self.cut_off, above=0.0, maximum=200.0)
        for name in ("inertia", "least_load"):
            require(name, getattr(self, name), minimum=0.0)
        for name in ("slip_accuracy", "friction_accuracy"):
            require(name, getattr(self, name), minimum=0.0, maximum=0.5)
        require("memory", self.memory, above=0.0)
        require("reach", self.reach, above=0.0)
        require("least_speed", self.least_speed, above=0.0)
        require("least_slip", self.least_slip, minimum=0.5, maximum=1.0)
        for name in ("slip_spread", "friction_spread"):
            require(name, getattr(self, name), above=0.0, maximum=1.0)
        require("least_blocks", self.least_blocks, minimum=5)

    def numbers(self) -> FloatArray:
        """Return the parameters as the kernels take them."""
        contact = self.contact
        relaxation, lateral_mu, lateral_lambda = 0.0, 1.0, 1.0
        if contact is not None:
            relaxation = contact.relaxation_length
            lateral_mu, lateral_lambda = contact.mu_p / contact.lateral.mu_p, contact.lambda_p / contact.lateral.lambda_p
        return np.array(
            [
                self.cut_off, relaxation, self.inertia, lateral_mu, lateral_lambda, self.slip_accuracy,
                self.friction_accuracy, self.memory, self.least_speed, self.least_load, self.least_slip, self.slip_spread,
                self.friction_spread, self.least_blocks, self.reach,
            ]
        )  # fmt: skip


@dataclasses.dataclass(frozen=True)
class WheelReading:
    """What is known of one wheel at one time.

    Attributes:
        rolling_speed: r rho_dot [m/s].
        velocity: of the wheel centre along its heading, over the ground [m/s].
        force: of the ground on the wheel along its heading [N]; tau_rho / r where the parameters have an inertia.
        normal_force: F_z [N].
        lateral_slip: slip velocity across [m/s].
        lateral_force: of the ground on the wheel across [N].
    """

    rolling_speed: float
    velocity: float
    force: float
    normal_force: float
    lateral_slip: float = 0.0
    lateral_force: float = 0.0


@dataclasses.dataclass(frozen=True)
class TerrainEstimate:
    """What is known of the ground under one wheel.

    Attributes:
        mu_p: peak friction coefficient [1]; NaN where nothing is known at all.
        lambda_p: critical slip ratio [1]; NaN likewise.
        covariance: of (log mu_p, log lambda_p) (2, 2); inf likewise.
        valid: whether the estimate is vouched for.
        reason: why not; one of `REASONS`.
        slip: current slip ratio, filtered and relaxed, positive along the force [1].
        friction: current friction coefficient, filtered [1].
        slip_noise: standard deviation of `slip` by noise [1].
        misfit: size of the residuals over what the noise explains [1].
        changes: how often the ground has changed so far.
        since_change: time since the last change, as far as is known, or since the beginning [s].
        suspect: whether what is felt now contradicts the estimate, but not for long enough to be sure.
    """

    mu_p: float
    lambda_p: float
    covariance: FloatArray
    valid: bool
    reason: str
    slip: float
    friction: float
    slip_noise: float
    misfit: float
    changes: int
    since_change: float
    suspect: bool

    def interval(self, deviations: float = 1.96) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the intervals of mu_p and of lambda_p; 95 % with the default."""
        half = deviations * np.sqrt(np.diag(self.covariance))
        return (
            (self.mu_p * math.exp(-half[0]), self.mu_p * math.exp(half[0])),
            (self.lambda_p * math.exp(-half[1]), self.lambda_p * math.exp(half[1])),
        )


@compiled
def noise_gain(pole, dt):  # type: ignore[no-untyped-def]
    """Return the variance that white noise of variance 1 has behind two equal poles p = exp(-pole dt), sampled every dt."""
    p = math.exp(-pole * dt)
    return (1.0 - p) * (1.0 + p * p) / (1.0 + p) ** 3


@compiled
def block_share(pole, rate, time, apart):  # type: ignore[no-untyped-def]
    """Return the part of `noise_gain` that is left behind one more pole `rate` [1/s] (inf: none) and in the mean over `time`.

    Of two such means that begin `apart` [s] from each other it is the covariance. The ratio of two integrals over the
    spectrum, with omega = pole tan(angle).
    """
    passed, all_of_it = 0.0, 0.0
    for k in range(SPECTRUM_POINTS):
        angle = (k + 0.5) * 0.5 * math.pi / SPECTRUM_POINTS
        omega = pole * math.tan(angle)
        density = math.cos(angle) ** 2  # 1 / (1 + tan^2)^2 d omega
        half = 0.5 * omega * time
        window = (math.sin(half) / half) ** 2
        all_of_it += density
        passed += density * window * math.cos(omega * apart) / (1.0 + (omega / rate) ** 2)
    return passed / all_of_it


@compiled
def block_shares(pole, rate, time, shares):  # type: ignore[no-untyped-def]
    """Fill shares (m,) with `block_share` of means that begin 0, 1, ... m - 1 times `time` from each other."""
    shares[:] = 0.0
    all_of_it = 0.0
    for k in range(SPECTRUM_POINTS):
        angle = (k + 0.5) * 0.5 * math.pi / SPECTRUM_POINTS
        omega = pole * math.tan(angle)
        density = math.cos(angle) ** 2
        half = 0.5 * omega * time
        passed = density * (math.sin(half) / half) ** 2 / (1.0 + (omega / rate) ** 2)
        all_of_it += density
        # cos(m a) from the two before it.
        twice = 2.0 * math.cos(omega * time)
        before, now = 0.5 * twice, 1.0
        for m in range(len(shares)):
            shares[m] += passed * now
            before, now = now, twice * now - before
    shares /= all_of_it


@compiled
def ends_share(apart):  # type: ignore[no-untyped-def]
    """Return the covariance of the differences of two blocks' ends that lie `apart` blocks from each other.

    In units of the filtered noise's variance, whose correlation over u time constants is (1 + u) exp(-u). What one block
    gains its neighbour loses: the sum over all blocks is nothing.
    """
    total = 0.0
    for shift, factor in ((0.0, 2.0), (-1.0, -1.0), (1.0, -1.0)):
        u = abs(apart + shift) * BLOCK_TIME_CONSTANTS
        total += factor * (1.0 + u) * math.exp(-u)
    return total


@compiled
def _smooth(state, index, value, share):  # type: ignore[no-untyped-def]
    state[index] += share * (value - state[index])
    state[index + 1] += share * (state[index] - state[index + 1])


@compiled
def _grid(j):  # type: ignore[no-untyped-def]
    return LEAST_CRITICAL_SLIP * math.exp(j * math.log(GREATEST_CRITICAL_SLIP / LEAST_CRITICAL_SLIP) / (GRID - 1))


@compiled
def _square_of_friction(sums, j):  # type: ignore[no-untyped-def]
    """Return the mean of mu_p^2 at a lambda_p of the grid, as far as felt friction tells; see `FELT_DEVIATIONS`."""
    usual = 1.0 / USUAL_SPREAD**2
    share = max(sums[j, _FELT_ZG], 0.0) / max(sums[j, _FELT_ZZ], 1e-300)
    information = share * sums[j, _FELT_ZG] + usual
    mu = (share * sums[j, _FELT_ZY] + usual * USUAL_FRICTION) / information
    mu = min(max(mu, LEAST_FRICTION), GREATEST_FRICTION)
    return mu * mu + 1.0 / information


@compiled
def _add_block(table, numbers, state, sums, now, lag, apart, lag_signs, averaged, spread):  # type: ignore[no-untyped-def]
    """Add one block of the history to the sums of every lambda_p.

    `lag` is the instrument's slip, the mean of two blocks that lie `apart` blocks from this one, each along its own force;
    `lag_signs` is 1 if both forces point the way that this block's does, 0 if one does, -1 if none. `averaged` is the slip
    around the block, `spread` the deviation of that.
    """
    slip, slip_variance, friction, friction_variance, bending = now[0], now[1], now[2], now[3], now[6]
    pole = POLE_PER_CUT_OFF * numbers[_CUT_OFF]
    time = BLOCK_TIME_CONSTANTS / pole
    relaxing = now[11] if now[11] > 0.0 else math.inf
    # Covariances of the noise of this block with that of blocks before it, of slip and friction.
    of_slip, of_force, of_friction = np.empty(PAIRS), np.empty(3), np.zeros(PAIRS)
    block_shares(pole, relaxing, time, of_slip)
    block_shares(pole, math.inf, time, of_force)
    of_slip *= now[10]
    for m in range(3):
        of_friction[m] = now[12] * ends_share(m) + now[13] * of_force[m]
    # What does not belong together of a slip that moves.
    moving = max(slip_variance - now[15], 0.0)
    shared = lag_signs * of_slip[min(apart, PAIRS - 1)]
    best = state[_RESULT + 1]
    informative = 1.0
    if best > 0.0:
        informative = min(1.0, max(abs(lag), abs(slip)) / (INFORMATIVE_SLIP * best))
    keep = math.exp(-informative * time / numbers[_MEMORY])
    state[_WEIGHT] = keep * state[_WEIGHT] + 1.0
    state[_BLOCKS] += 1.0
    taken = int(state[_TAKEN])
    # How many blocks ago the last ones were, and whether the force had the same sign.
    ago, alike = np.zeros(PAIRS, np.int64), np.zeros(PAIRS)
    for i in range(PAIRS):
        ago[i] = round(abs(now[4] - state[_TAKEN + 1 + 2 * i]) / time)
        alike[i] = now[14] * state[_TAKEN + 2 + 2 * i]
    # The instrument is the mean of two blocks.
    felt = abs(lag) > FELT_DEVIATIONS * math.sqrt(0.5 * slip_variance)
    felt = felt and abs(friction) > FELT_DEVIATIONS * math.sqrt(friction_variance)
    for j in range(GRID):
        critical = _grid(j)
        x, x_lag = slip / critical, lag / critical
        per_square = 1.0 / (critical * critical)
        s2 = slip_variance * per_square
        g, slope_now, bend = shape_at(table, x)
        corrected = g - 0.5 * bend * bending * per_square
        z, slope, bend_lag = shape_at(table, x_lag)
        a = -x_lag * slope
        square = _square_of_friction(sums, j)
        variance = friction_variance + square * s2 * (slope * slope + bend_lag * bend_lag * s2)
        w = 1.0 / variance
        # How well the curve fits is judged by the slope at the block itself as well: weights that know its noise would bias.
        steep, bent = max(slope * slope, slope_now * slope_now), max(bend * bend, bend_lag * bend_lag)
        spread_here = friction_variance + square * s2 * (steep + 0.5 * bent * s2)
        sure = 1.0 / spread_here
        for k in range(_PAIRED):
            sums[j, k] *= keep
        sums[j, _ZZ] += w * z * z
        sums[j, _ZA] += w * z * a
        sums[j, _AA] += w * a * a
        # What noise, and a slip that is hardly another one, make of both where the slip is always the same.
        tremble = 0.5 * of_slip[0] * per_square + (STEADY_PART * x_lag) ** 2
        bent_a = -slope - x_lag * bend_lag
        sums[j, _STEADY_ZZ] += w * slope * slope * tremble
        sums[j, _STEADY_ZA] += w * slope * bent_a * tremble
        sums[j, _STEADY_AA] += w * bent_a * bent_a * tremble
        sums[j, _ZY] += w * z * friction
        sums[j, _ZG] += w * (z * corrected - slope * slope_now * shared * per_square)
        if felt:
            sums[j, _FELT_ZZ] += w * z * z
            sums[j, _FELT_ZY] += w * z * friction
            sums[j, _FELT_ZG] += w * (z * corrected - slope * slope_now * shared * per_square)
        sums[j, _AY] += w * a * friction
        sums[j, _AG] += w * (a * corrected + (slope + x_lag * bend_lag) * slope_now * shared * per_square)
        sums[j, _YY] += sure * friction * friction
        sums[j, _GY] += sure * corrected * friction
        sums[j, _GG] += sure * corrected * corrected
        sums[j, _LOG] += math.log(spread_here)
        sums[j, _W] += 1.0
        if abs(averaged) - 3.0 * spread >= numbers[_LEAST_SLIP] * critical:
            sums[j, _BEYOND] += 1.0
        # What the measured noise of this block and of those before it makes of both equations. The square of a slope that was
        # taken at a noisy slip is too large by bend^2 noise; what noise does by the bend itself is half of that, and is there.
        # What slip makes goes with mu_p^2, which is not known yet.
        noise = of_slip[0] * per_square
        by_bend = 0.5 * bend * bend * noise
        by_slip = noise * max(slope_now * slope_now - by_bend, by_bend)
        by_slip += moving * per_square * max(slope_now * slope_now, slope * slope)
        p, q = w * z, w * a
        sums[j, _NOISE_ZZ] += of_friction[0] * p * p
        sums[j, _NOISE_ZA] += of_friction[0] * p * q
        sums[j, _NOISE_AA] += of_friction[0] * q * q
        sums[j, _NOISE_SHARE] += of_friction[0] * w
        sums[j, _SLIP_ZZ] += by_slip * p * p
        sums[j, _SLIP_ZA] += by_slip * p * q
        sums[j, _SLIP_AA] += by_slip * q * q
        sums[j, _SLIP_SHARE] += by_slip * w
        for i in range(PAIRS):
            m = ago[i]
            if 0 < m < PAIRS:
                at = _PAIRED + 4 * i
                noise = of_slip[m] * per_square
                by_slip = alike[i] * noise * (slope_now * sums[j, at + 2] - 0.5 * bend * sums[j, at + 3] * noise)
                by_friction = alike[i] * of_friction[m]
                zz, za, aa = 2.0 * p * sums[j, at], p * sums[j, at + 1] + q * sums[j, at], 2.0 * q * sums[j, at + 1]
                sums[j, _NOISE_ZZ] += by_friction * zz
                sums[j, _NOISE_ZA] += by_friction * za
                sums[j, _NOISE_AA] += by_friction * aa
                sums[j, _SLIP_ZZ] += by_slip * zz
                sums[j, _SLIP_ZA] += by_slip * za
                sums[j, _SLIP_AA] += by_slip * aa
        at = _PAIRED + 4 * taken
        sums[j, at], sums[j, at + 1], sums[j, at + 2], sums[j, at + 3] = p, q, slope_now, bend
    state[_TAKEN + 1 + 2 * taken], state[_TAKEN + 2 + 2 * taken] = now[4], now[14]
    state[_TAKEN] = (taken + 1) % PAIRS


@compiled
def _equation(sums, j):  # type: ignore[no-untyped-def]
    """Return mu_p and the second equation's left side at a lambda_p of the grid."""
    mu = sums[j, _ZY] / max(sums[j, _ZG], 1e-300)
    return mu, sums[j, _AY] - mu * sums[j, _AG]


@compiled
def _varied(sums, j, allowed):  # type: ignore[no-untyped-def]
    """Return whether slips are varied enough to tell a lambda_p of the grid from mu_p; `allowed`: see `STAYS_VALID`."""
    share = sums[j, _ZA] / max(sums[j, _ZZ], 1e-300)
    apart = sums[j, _AA] - share * sums[j, _ZA]
    by_noise = sums[j, _STEADY_AA] - 2.0 * share * sums[j, _STEADY_ZA] + share * share * sums[j, _STEADY_ZZ]
    by_chance = VARIED_CHANCE * math.sqrt(2.0 / max(sums[j, _W], 1.0))
    return apart * allowed * allowed > (VARIED + by_chance) * by_noise


@compiled
def _noise_of_equations(sums, j, mu, noise, rest):  # type: ignore[no-untyped-def]
    """Return variances and covariance of both equations at a lambda_p of the grid: zz, za, aa.

    `noise` is by how much the measured noise counts, `rest` the part of the residuals' variance that it does not explain.
    """
    square = mu * mu
    zz = noise * max(sums[j, _NOISE_ZZ] + square * sums[j, _SLIP_ZZ], 0.0) + rest * sums[j, _ZZ]
    za = noise * (sums[j, _NOISE_ZA] + square * sums[j, _SLIP_ZA]) + rest * sums[j, _ZA]
    aa = noise * max(sums[j, _NOISE_AA] + square * sums[j, _SLIP_AA], 0.0) + rest * sums[j, _AA]
    return zz, za, aa


@compiled
def _second_variance(sums, j, zz, za, aa):  # type: ignore[no-untyped-def]
    """Return the variance of the second equation, of which the first has taken mu_p, and what it takes of that."""
    share = sums[j, _AG] / sums[j, _ZG]
    return max(aa - 2.0 * share * za + share * share * zz, 1e-300), share


@compiled
def _holds_as_far_as(sums, left, part, side, noise, rest):  # type: ignore[no-untyped-def]
    """Return how far from its root, at left + part, the second equation still holds within its noise [steps of the grid].

    `side` is 1 for larger lambda_p and -1 for smaller ones. Where a few blocks tell lambda_p the equation is no straight line,
    and its slope at the root, which has the same noise in it, says too little of what else is possible.
    """
    root = left + part
    j, before, at = (left + 1 if side > 0 else left), 0.0, root
    while 0 <= j < GRID and sums[j, _ZG] > 0.0:
        mu, h = _equation(sums, j)
        zz, za, aa = _noise_of_equations(sums, j, mu, noise, rest)
        variance, _ = _second_variance(sums, j, zz, za, aa)
        deviations = abs(h) / math.sqrt(variance)
        if deviations >= INTERVAL_DEVIATIONS:
            return abs(at + (j - at) * (INTERVAL_DEVIATIONS - before) / (deviations - before) - root)
        before, at = deviations, float(j)
        j += side
    return abs(at - root)


@compiled
def _solve(numbers, state, sums):  # type: ignore[no-untyped-def]
    """Write the result into the state."""
    result = state[_RESULT : _RESULT + 8]
    allowed = STAYS_VALID if result[5] > 0.0 else 1.0
    result[:] = 0.0
    result[7] = TOO_FEW
    if state[_BLOCKS] < numbers[_LEAST_BLOCKS]:
        return
    best, least, straight = -1, math.inf, math.inf
    for j in range(GRID):
        if sums[j, _ZG] <= 0.0:
            continue
        mu, _ = _equation(sums, j)
        if mu <= 0.0:
            continue
        cost = sums[j, _LOG] + sums[j, _YY] - 2.0 * mu * sums[j, _GY] + mu * mu * sums[j, _GG]
        if cost < least:
            best, least = j, cost
        straight = cost
    if best < 0:
        result[7] = WRONG_SIGN if state[_WRONG_SIGN] >= WRONG_SIGN_BLOCKS else TOO_LITTLE_SLIP
        return
    # The root of the second equation next to the least error: between two points of the grid where its sign changes.
    left = -1
    for distance in range(GRID):
        for j in (best - 1 - distance, best + distance):
            if 0 <= j < GRID - 1 and left < 0 and sums[j, _ZG] > 0.0 and sums[j + 1, _ZG] > 0.0:
                _, h0 = _equation(sums, j)
                _, h1 = _equation(sums, j + 1)
                if (h0 > 0.0) != (h1 > 0.0):
                    left = j
        if left >= 0:
            break
    if left < 0:
        mu, _ = _equation(sums, best)
        result[0], result[1], result[2], result[4] = mu, _grid(best), 1.0, 1.0
        result[7] = TOO_LITTLE_SLIP if best >= GRID // 2 else AT_A_BOUND
        return
    mu0, h0 = _equation(sums, left)
    mu1, h1 = _equation(sums, left + 1)
    part = h0 / (h0 - h1)
    step = math.log(_grid(left + 1) / _grid(left))
    j = left + 1 if part > 0.5 else left
    critical = _grid(left) * math.exp(part * step)
    mu = max(mu0, 1e-6) ** (1.0 - part) * max(mu1, 1e-6) ** part
    slope = (h1 - h0) / step
    follows = math.log(max(mu1, 1e-6) / max(mu0, 1e-6)) / step
    count = state[_WEIGHT]
    squares = sums[j, _YY] - 2.0 * mu * sums[j, _GY] + mu * mu * sums[j, _GG]
    scale = (PRIOR_BLOCKS + max(squares, 0.0)) / (PRIOR_BLOCKS + max(count - 2.0, 0.0))
    # Noise that was measured counts as it goes from block to block; what the residuals are beyond it, and beyond what chance
    # makes of so many, goes together as they do.
    explained = (sums[j, _NOISE_SHARE] + mu * mu * sums[j, _SLIP_SHARE]) / max(sums[j, _W], 1.0)
    noise = min(1.0 + CHANCE * math.sqrt(2.0 / max(count, 1.0)), scale / max(explained, 1e-12))
    rest = max(scale - noise * explained, 0.0)
    correlation = min(max(state[_CORRELATION], 0.0), 0.8)
    rest *= (1.0 + correlation) / (1.0 - correlation)
    zz, za, aa = _noise_of_equations(sums, j, mu, noise, rest)
    h_variance, share = _second_variance(sums, j, zz, za, aa)
    slip_variance = h_variance / (slope * slope)
    for side in (-1, 1):
        far = _holds_as_far_as(sums, left, part, side, noise, rest) * step / INTERVAL_DEVIATIONS
        slip_variance = max(slip_variance, far * far)
    own = zz / (sums[j, _ZG] * mu) ** 2
    together = (za - share * zz) / (sums[j, _ZG] * mu)
    mu_variance = own + follows * follows * slip_variance - 2.0 * follows / slope * together
    covariance = follows * slip_variance - together / slope
    systematic = (numbers[_SLIP_ACCURACY] / critical) ** 2
    slip_variance += systematic
    mu_variance = max(mu_variance, own) + numbers[_FRICTION_ACCURACY] ** 2
    limit = 0.999 * math.sqrt(slip_variance * mu_variance)
    result[0], result[1], result[2], result[4] = mu, critical, mu_variance, slip_variance
    result[3] = min(max(covariance, -limit), limit)
    result[6] = math.sqrt(scale)
    upper = critical * math.exp(3.0 * min(math.sqrt(slip_variance), 3.0))
    where = math.ceil(math.log(upper / LEAST_CRITICAL_SLIP) / step)
    if state[_WRONG_SIGN] >= WRONG_SIGN_BLOCKS:
        result[7] = WRONG_SIGN
    elif where >= GRID or sums[where, _BEYOND] < BEYOND_BLOCKS or straight - least < BENT * scale:
        result[7] = TOO_LITTLE_SLIP
    elif state[_SLIP_NOISE] > GREATEST_NOISE * critical or not _varied(sums, j, allowed):
        result[7] = TOO_LITTLE_SLIP
    elif not (LEAST_FRICTION < mu < GREATEST_FRICTION):
        result[7] = AT_A_BOUND
    elif max(math.sqrt(slip_variance) / numbers[_SLIP_SPREAD], math.sqrt(mu_variance) / numbers[_FRICTION_SPREAD]) > allowed:
        result[7] = TOO_WIDE
    elif result[6] > GREATEST_MISFIT:
        result[7] = NO_FIT
    else:
        result[5], result[7] = 1.0, VALID


@compiled
def _forget(state, sums):  # type: ignore[no-untyped-def]
    sums[:] = 0.0
    for index in (_WEIGHT, _BLOCKS, _CORRELATION, _LAST_RESIDUAL, _UP, _DOWN, _SUSPECT, _WRONG_SIGN, _ABOVE):
        state[index] = 0.0
    state[_RESULT : _RESULT + 8] = 0.0
    state[_RESULT + 7] = TOO_FEW


@compiled
def _begin_anew(state, sums, history):  # type: ignore[no-untyped-def]
    """Give up what has been learned of a ground that is another one now."""
    _forget(state, sums)
    state[_CHANGES] += 1.0
    state[_CHANGE_TIME], state[_OPENED] = state[_TIME], 0.0
    history[:, 5] = 0.0


@compiled
def _speed_noise(numbers, state, k):  # type: ignore[no-untyped-def]
    """Return the variance of one reading of rolling speed (k = 0) or velocity (1) in the block that ends now.

    Noise may grow with the speed. Where that has grown meanwhile, the mean over the last time is too small.
    """
    speed = state[_MEAN + k] / state[_BLOCK_TIME]
    return state[_NOISE + k] * max(speed * speed / max(state[_SQUARE + k], numbers[_LEAST_SPEED] ** 2), 1.0)


@compiled
def _friction_noise(numbers, state, full_gain, load):  # type: ignore[no-untyped-def]
    """Return the noise of a block's friction by the wheel's acceleration and by the force, each per unit of its share."""
    per_time = numbers[_INERTIA] / state[_BLOCK_TIME]
    gain = full_gain / (load * load)
    return gain * per_time * per_time * _speed_noise(numbers, state, 0), gain * state[_NOISE + 2]


@compiled
def _holds_too_much(numbers, state, full_gain, friction, load):  # type: ignore[no-untyped-def]
    """Whether a wheel has held more than the ground that it is said to stand on can hold, for long enough."""
    result = state[_RESULT : _RESULT + 8]
    if result[5] == 0.0:
        state[_ABOVE] = 0.0
        return False
    ends_unit, force_unit = _friction_noise(numbers, state, full_gain, load)
    noise = ABOVE_DEVIATIONS * math.sqrt(ends_unit * ends_share(0.0) + force_unit)
    most = result[0] * math.exp(ABOVE_DEVIATIONS * math.sqrt(result[2])) * (1.0 + ABOVE_PART)
    state[_ABOVE] = max(state[_ABOVE] + (1.0 if friction > most + noise else -1.0), 0.0)
    return state[_ABOVE] >= ABOVE_BLOCKS


@compiled
def _take(table, numbers, state, sums, history, last, begin):  # type: ignore[no-untyped-def]
    """Add the blocks whose instrument is complete with block `last` of the history, not looking at blocks before `begin`."""
    for index in range(begin, last - LEAST_LAG + 1):
        lag = LEAST_LAG if state[_BLOCKS] < YOUNG_BLOCKS else max(int(history[index, 7]), LEAST_LAG)
        if history[index, 5] < 1.0 or history[index, 8] > 0.0 or index + lag > last or index - lag < begin:
            continue
        whole = True
        for k in range(index - lag, index + lag + 1):
            whole = whole and history[k, 5] > 0.0
        if not whole:
            continue
        now = history[index]
        now[8] = 1.0
        averaged, spread = 0.0, 0.0
        for k in range(index - LEAST_LAG, index + LEAST_LAG + 1):
            averaged += history[k, 0] / (2 * LEAST_LAG + 1)
            spread += history[k, 1]
        # Neighbours are correlated by filter and tyre, which widens their mean by a half.
        spread = 1.5 * math.sqrt(spread) / (2 * LEAST_LAG + 1)
        instrument = 0.5 * (history[index - lag, 0] + history[index + lag, 0])
        signs = 0.5 * now[14] * (history[index - lag, 14] + history[index + lag, 14])
        _add_block(table, numbers, state, sums, now, instrument, lag, signs, averaged, spread)


@compiled
def _watch(table, numbers, state, history):  # type: ignore[no-untyped-def]
    """Compare the newest block with the estimate; returns whether the ground has changed."""
    now = history[_HISTORY - 1]
    mu, critical = state[_RESULT], state[_RESULT + 1]
    if now[5] < 1.0 or mu <= 0.0 or critical <= 0.0:
        return False
    x, s2 = now[0] / critical, now[1] / critical**2
    g, slope, bend = shape_at(table, x)
    residual = now[2] - mu * (g - 0.5 * bend * now[6] / critical**2)
    lag = history[_HISTORY - 1 - max(int(now[7]), LEAST_LAG)]
    _, slope_lag, bend_lag = shape_at(table, lag[0] / critical if lag[5] > 0.0 else x)
    steep = max(slope * slope, slope_lag * slope_lag)
    bent = max(bend * bend, bend_lag * bend_lag)
    scale = max(state[_RESULT + 6], 1.0) ** 2
    variance = scale * (now[3] + mu * mu * (steep * s2 + 0.5 * bent * s2 * s2))
    expected = residual / math.sqrt(variance)
    # How far residuals of neighbouring blocks go together, in units of their variance.
    share = max(CORRELATION_SHARE, 1.0 / state[_BLOCKS])
    state[_CORRELATION] += share * (min(max(expected * state[_LAST_RESIDUAL], -4.0), 4.0) - state[_CORRELATION])
    state[_LAST_RESIDUAL] = min(max(expected, -3.0), 3.0)
    # Valid or not: what counts is that something is known to compare with. Of a few blocks the spreads are not known either.
    if state[_RESULT + 5] == 0.0 and state[_WEIGHT] < YOUNG_BLOCKS:
        return False
    if state[_RESULT + 2] > COMPARABLE[0] ** 2 or state[_RESULT + 4] > COMPARABLE[1] ** 2:
        return False
    # Residuals that go together add up faster than by chance.
    together = min(max(state[_CORRELATION], 0.0), 0.5)
    variance *= (1.0 + together) / (1.0 - together)
    variance += (mu * slope * numbers[_SLIP_ACCURACY] / critical) ** 2 + (CHANGE_FLOOR * now[2]) ** 2
    # Of few blocks the spread is not known well either.
    young = 1.0 + YOUNG_BLOCKS / max(state[_WEIGHT], 1.0)
    variance += young * mu * mu * (g * g * state[_RESULT + 2] + slope * slope * x * x * state[_RESULT + 4])
    t = math.copysign(1.0, now[2]) * residual / math.sqrt(variance)
    t = min(max(t, -LARGEST_RESIDUAL), LARGEST_RESIDUAL)
    now[9] = t
    state[_UP] = max(0.0, state[_UP] + t - ALLOWED_RESIDUAL)
    state[_DOWN] = max(0.0, state[_DOWN] - t - ALLOWED_RESIDUAL)
    suspect = state[_UP] > 0.0 or state[_DOWN] > 0.0
    state[_SUSPECT] = state[_SUSPECT] + 1.0 if suspect else 0.0
    return max(state[_UP], state[_DOWN]) > CHANGE_THRESHOLD


@compiled
def _began(state, history):  # type: ignore[no-untyped-def]
    """Return the first block of the history that lies on the new ground as a whole.

    The sum of residuals was last zero before the ground changed, as chance may have begun it. That it changed with block k is
    most likely where the sum from k on of |t| less half of what it is now is largest; block k itself stands on both grounds.
    """
    sign = 1.0 if state[_UP] > state[_DOWN] else -1.0
    earliest = max(_HISTORY - max(int(state[_SUSPECT]), 1), 0)
    size = 0.0
    for k in range(_HISTORY - JUMP_BLOCKS, _HISTORY):
        size += sign * history[k, 9] / JUMP_BLOCKS
    total, most, where = 0.0, -math.inf, _HISTORY - 1
    for k in range(_HISTORY - 1, earliest - 1, -1):
        total += sign * history[k, 9] - 0.5 * size
        if total > most:
            most, where = total, k
    return min(where + 1, _HISTORY - 1)


@compiled
def _block(table, numbers, state, sums, history, pole, dt):  # type: ignore[no-untyped-def]
    """Close a block: sample the filtered signals, watch for a change, add it, solve."""
    mean = state[_MEAN : _MEAN + 7] / state[_BLOCK_TIME]
    rolling, velocity = mean[0], mean[1]
    force_x = mean[2] - numbers[_INERTIA] * (state[_ROLLING + 1] - state[_BEGAN_AT]) / state[_BLOCK_TIME]
    force_y, load = mean[3] * numbers[_LATERAL_MU], mean[4]
    speed = max(abs(rolling), abs(velocity))
    for k in range(_HISTORY - 1):
        history[k] = history[k + 1]
    now = history[_HISTORY - 1]
    now[:] = 0.0
    force = math.hypot(force_x, force_y)
    full_gain = noise_gain(pole, dt)
    settled, slip_now = state[_NOISE_TIME] > NOISE_SETTLED, mean[5]
    usable = settled and abs(slip_now) <= 1.0 and speed > numbers[_LEAST_SPEED] and load > numbers[_LEAST_LOAD] and force > 0.0
    known = state[_KNOWN_FOR] >= KNOWN_BLOCKS * BLOCK_TIME_CONSTANTS / pole
    # Where the slip is known a change shows sooner, see `_watch`.
    if usable and not known and _holds_too_much(numbers, state, full_gain, force / load, load):
        _begin_anew(state, sums, history)
    usable = usable and known
    state[_WAY] = 0.0 if usable else state[_WAY] + speed * state[_BLOCK_TIME]
    if not usable:
        state[_SLIP], state[_FRICTION], state[_SLIP_NOISE] = 0.0, 0.0, 0.0
        if state[_RESULT + 5] > 0.0 and state[_WAY] > numbers[_REACH]:
            state[_RESULT + 5], state[_RESULT + 7] = 0.0, TOO_FAR
        return
    slip_y = mean[6] * numbers[_LATERAL_LAMBDA]
    # Along the force, forwards or backwards: the size alone would turn noise into friction.
    sign = 1.0 if force_x >= 0.0 else -1.0
    slip = sign * (mean[5] * force_x + slip_y * force_y) / force
    along = force_x / force
    # Of lambda = 1 - v / (r rho_dot), and of its mirror in braking.
    other = min(abs(rolling), abs(velocity)) / speed
    larger, smaller = _speed_noise(numbers, state, 0), _speed_noise(numbers, state, 1)
    if abs(velocity) > abs(rolling):
        larger, smaller = smaller, larger
    relaxing, relaxed_blocks = math.inf, 0
    if numbers[_RELAXATION] > 0.0:
        relaxing = speed / numbers[_RELAXATION]
        relaxed_blocks = math.ceil(RELAXATION_LAG * numbers[_RELAXATION] / speed * pole / BLOCK_TIME_CONSTANTS)
    # Of the slip per unit of its gain: filter and tyre carry noise from one block to the next, and to its difference from it.
    noise = full_gain * (other * other * larger + smaller) / (speed * speed) * along * along
    slip_shares, force_shares = np.empty(2), np.empty(1)
    block_shares(pole, relaxing, state[_BLOCK_TIME], slip_shares)
    block_shares(pole, math.inf, state[_BLOCK_TIME], force_shares)
    slip_variance, together = noise * slip_shares[0] + 1e-10, noise * slip_shares[1]
    friction = sign * force / load
    ends_unit, force_unit = _friction_noise(numbers, state, full_gain, load)
    friction_variance = ends_unit * ends_share(0.0) + force_unit * force_shares[0]
    accuracy = max(numbers[_FRICTION_ACCURACY], 0.002) * friction
    friction_variance += accuracy * accuracy + 1e-10
    now[0], now[1], now[2], now[3], now[4], now[5] = slip, slip_variance, friction, friction_variance, state[_TIME], 1.0
    # Only where there is noise does the instrument have to be free of it; nearer in time it is the better one.
    noisy = slip_variance > (QUIET_NOISE * slip) ** 2
    now[7] = min(LEAST_LAG + relaxed_blocks if noisy else LEAST_LAG, (_HISTORY - 1) // 2)
    # What does not average out spreads the residuals as well.
    now[1] += numbers[_SLIP_ACCURACY] ** 2
    now[10], now[11], now[12], now[13] = noise, relaxing if relaxing < math.inf else 0.0, ends_unit, force_unit
    now[14], now[15] = sign, now[1]
    # The mean of a curve is bent by noise, and the mean friction by slip that moves within the filter's memory, 2 / pole^2.
    now[6] = slip_variance
    if history[_HISTORY - 2, 5] > 0.0:
        now[1] += (MOVING_ACCURACY * (slip - history[_HISTORY - 2, 0])) ** 2
        before = history[_HISTORY - 2, 1] - numbers[_SLIP_ACCURACY] ** 2
        moved = (slip - history[_HISTORY - 2, 0]) ** 2 - slip_variance - before + 2.0 * together
        now[6] -= BLOCK_SPREAD * moved
        # Where it moves by half of itself between two blocks this is no longer the first term of a series.
        steady = UNSTEADY_SLIP * max(abs(slip), abs(history[_HISTORY - 2, 0])) + 4.0 * math.sqrt(slip_variance)
        if abs(slip - history[_HISTORY - 2, 0]) > steady:
            now[5] = 0.5
    state[_SLIP], state[_FRICTION], state[_SLIP_NOISE] = sign * slip, abs(friction), math.sqrt(slip_variance)
    enough = WRONG_SIGN_DEVIATIONS * math.sqrt(slip_variance) + numbers[_SLIP_ACCURACY]
    if abs(friction) > 0.01 + WRONG_SIGN_DEVIATIONS * math.sqrt(friction_variance) and abs(slip) > enough:
        vote = 1.0 if slip * friction < 0.0 else -1.0
        state[_WRONG_SIGN] = min(max(state[_WRONG_SIGN] + vote, 0.0), 2.0 * WRONG_SIGN_BLOCKS)
    if _watch(table, numbers, state, history):
        begin = _began(state, history)
        changes, opened = state[_CHANGES] + 1.0, history[begin, 4]
        _forget(state, sums)
        state[_CHANGES], state[_CHANGE_TIME], state[_OPENED] = changes, opened, 0.0
        history[:begin, 5] = 0.0
        history[begin:, 8] = 0.0
        _take(table, numbers, state, sums, history, _HISTORY - 1, begin)
    elif max(state[_UP], state[_DOWN]) > SUSPENDED and state[_SUSPECT] <= LONGEST_SUSPENSION:
        return
    else:
        _take(table, numbers, state, sums, history, _HISTORY - 1, 0)
    _solve(numbers, state, sums)
    # Readings that no curve fits come from more than one ground, or from a curve that is another one: begin anew.
    state[_MISFITS] = state[_MISFITS] + 1.0 if state[_RESULT + 6] > GREATEST_MISFIT else 0.0
    if state[_MISFITS] > LONGEST_MISFIT:
        _forget(state, sums)
        state[_CHANGE_TIME], state[_MISFITS] = state[_TIME], 0.0
        history[:, 5] = 0.0


@compiled
def _note_noise(state, k, now, count, dt, before_it):  # type: ignore[no-untyped-def]
    """Take the mean of `count` readings of a signal, after `before_it` other such means, into the noise of one reading."""
    before, latest = state[_BEFORE + 2 * k], state[_BEFORE + 2 * k + 1]
    if before_it >= 2.0:
        # The second difference of white noise has six times its variance; a smooth signal has next to none.
        square = count * (now - 2.0 * latest + before) ** 2 / 6.0
        forgotten = 1.0 - math.exp(-count * dt / NOISE_MEMORY)
        forgotten = max(forgotten, 1.0 / (before_it - 1.0))
        state[_NOISE + k] += forgotten * (square - state[_NOISE + k])
        if k < 2:
            state[_SQUARE + k] += forgotten * (latest * latest - state[_SQUARE + k])
    state[_BEFORE + 2 * k], state[_BEFORE + 2 * k + 1] = latest, now


@compiled
def advance(table, numbers, state, sums, history, reading, dt):  # type: ignore[no-untyped-def]
    """Take one reading (6,) in place: rolling speed, velocity, force, normal force, lateral slip, lateral force.

    A normal force below zero is one of that size in a reading whose slip is not known.
    """
    pole = POLE_PER_CUT_OFF * numbers[_CUT_OFF]
    share = 1.0 - math.exp(-pole * dt)
    first = state[_READINGS] == 0.0
    began_at = state[_ROLLING + 1] if not first else reading[0]
    values = (
        (_ROLLING, reading[0]), (_VELOCITY, reading[1]), (_FORCE, reading[2]), (_LOAD, abs(reading[3])), (_SLIP_Y, reading[4]),
        (_FORCE_Y, reading[5]),
    )  # fmt: skip
    for index, value in values:
        if first:
            state[index], state[index + 1] = value, value
        else:
            _smooth(state, index, value, share)
    # Of speeds it is that of their means over a time that the filter lets pass: the noise of differences of encoder counts is
    # small there, and noise that lasts is not. Forces have ripples faster than that, which the filter takes away.
    state[_AVERAGED] += 1.0
    whole = state[_AVERAGED] * dt >= NOISE_TIME - 0.5 * dt
    for k in range(2):
        state[_AVERAGE + k] += reading[k]
        if whole:
            _note_noise(state, k, state[_AVERAGE + k] / state[_AVERAGED], state[_AVERAGED], dt, state[_AVERAGES])
            state[_AVERAGE + k] = 0.0
    if whole:
        state[_AVERAGED] = 0.0
        state[_AVERAGES] += 1.0
    _note_noise(state, 2, reading[2], 1.0, dt, state[_READINGS])
    state[_READINGS] += 1.0
    state[_TIME] += dt
    state[_KNOWN_FOR] = state[_KNOWN_FOR] + dt if reading[3] > 0.0 else 0.0
    state[_NOISE_TIME] += dt
    speed = max(abs(state[_ROLLING + 1]), abs(state[_VELOCITY + 1]), 1e-3)
    slip_x, slip_y = state[_ROLLING + 1] - state[_VELOCITY + 1], state[_SLIP_Y + 1]
    ratio_x, ratio_y, before_x, before_y = slip_x / speed, slip_y / speed, state[_Z_X], state[_Z_Y]
    lead_x, lead_y = 0.0, 0.0
    if numbers[_RELAXATION] > 0.0:
        # The slip goes straight from one reading to the next.
        passed = dt * speed / numbers[_RELAXATION]
        relaxed = 1.0 - math.exp(-passed)
        follows = 1.0 - relaxed / passed
        if first:
            state[_RATIO_X], state[_RATIO_Y] = ratio_x, ratio_y
        state[_Z_X] += relaxed * (state[_RATIO_X] - state[_Z_X]) + follows * (ratio_x - state[_RATIO_X])
        state[_Z_Y] += relaxed * (state[_RATIO_Y] - state[_Z_Y]) + follows * (ratio_y - state[_RATIO_Y])
        # The tyre's damping leads the force; see `contact_model`.
        lead = DAMPING_TIME * speed / numbers[_RELAXATION]
        lead_x, lead_y = lead * (ratio_x - state[_Z_X]), lead * (ratio_y - state[_Z_Y])
        state[_RATIO_X], state[_RATIO_Y] = ratio_x, ratio_y
    else:
        state[_Z_X], state[_Z_Y] = ratio_x, ratio_y
    # A torque is that since the reading before, in the mean half a step old; so is the slip that belongs to it.
    back = 0.5 if numbers[_INERTIA] > 0.0 and not first else 0.0
    state[_SINCE_BLOCK] += dt
    if state[_BLOCK_TIME] == 0.0:
        state[_BEGAN_AT] = began_at
    means = (
        state[_ROLLING + 1], state[_VELOCITY + 1], state[_FORCE + 1], state[_FORCE_Y + 1], state[_LOAD + 1],
        state[_Z_X] + back * (before_x - state[_Z_X]) + lead_x, state[_Z_Y] + back * (before_y - state[_Z_Y]) + lead_y,
    )  # fmt: skip
    for k in range(7):
        state[_MEAN + k] += dt * means[k]
    state[_BLOCK_TIME] += dt
    period = BLOCK_TIME_CONSTANTS / pole
    if state[_SINCE_BLOCK] >= period:
        state[_SINCE_BLOCK] = min(state[_SINCE_BLOCK] - period, period)
        _block(table, numbers, state, sums, history, pole, dt)
        state[_MEAN : _BLOCK_TIME + 1] = 0.0


@compiled
def run_wheels(tables, numbers, state, sums, history, readings, dt, every, results):  # type: ignore[no-untyped-def]
    """Take readings (T, n, 6) of n wheels in place, and note results (T / every, n, RESULTS).

    Numbers of all wheels are stacked. It is the one way into compiled code, as compiling it takes long.
    """
    for k in range(len(readings)):
        for i in range(readings.shape[1]):
            advance(tables[i], numbers[i], state[i], sums[i], history[i], readings[k, i], dt)
            if k % every == 0:
                row = results[k // every, i]
                row[:8] = state[i, _RESULT : _RESULT + 8]
                row[8], row[9], row[10], row[11] = (
                    state[i, _CHANGES],
                    state[i, _SLIP],
                    state[i, _FRICTION],
                    state[i, _SLIP_NOISE],
                )
                row[12], row[13] = state[i, _TIME] - state[i, _CHANGE_TIME], state[i, _SUSPECT]


@dataclasses.dataclass(frozen=True)
class TerrainState:
    """State of the estimator of n wheels; what its numbers are is the estimator's own matter."""

    numbers: FloatArray
    sums: FloatArray
    history: FloatArray


def initial_state(n: int = 1) -> TerrainState:
    """Return the state of n wheels before the first reading."""
    numbers = np.zeros((n, _STATE))
    numbers[:, _RESULT + 7] = TOO_FEW
    return TerrainState(numbers, np.zeros((n, GRID, _SUMS)), np.zeros((n, _HISTORY, _BLOCK)))


def ground_force(numbers: FloatArray, state: TerrainState, force: FloatArray, dt: float) -> FloatArray:
    """Return the forces of the ground along the headings (n,) [N] of torques over radius, (3.45) [Li2009].

    The acceleration of the wheels is that of the filter behind the last reading: none before the first.

    Args:
        numbers: parameters of all wheels, stacked; of forces that are those of the ground already the inertia is 0.
        state: after the reading before.
        force: torques over radius (n,) [N].
        dt: time between readings [s].
    """
    filtered = state.numbers[:, [_ROLLING, _ROLLING + 1]]
    # So far apart are both stages of a speed that grows steadily.
    delay = dt / np.expm1(POLE_PER_CUT_OFF * numbers[:, _CUT_OFF] * dt)
    acceleration = (filtered[:, 0] - filtered[:, 1]) / delay
    found: FloatArray = force - numbers[:, _INERTIA] * acceleration
    return found


def estimate_of(row: FloatArray) -> TerrainEstimate:
    """Return what one row of results (RESULTS,) says."""
    known = row[MU_P] > 0.0
    covariance = np.array([[row[MU_VARIANCE], row[COVARIANCE]], [row[COVARIANCE], row[LAMBDA_VARIANCE]]])
    return TerrainEstimate(
        mu_p=float(row[MU_P]) if known else math.nan,
        lambda_p=float(row[LAMBDA_P]) if known else math.nan,
        covariance=covariance if known else np.full((2, 2), np.inf),
        valid=bool(row[IS_VALID] > 0.0),
        reason=REASONS[int(row[REASON])],
        slip=float(row[SLIP]),
        friction=float(row[FRICTION]),
        slip_noise=float(row[SLIP_NOISE]),
        misfit=float(row[MISFIT]),
        changes=int(row[CHANGES]),
        since_change=float(row[SINCE_CHANGE]),
        suspect=bool(row[SUSPECT] > 0.0),
    )


class TerrainEstimator:
    """The estimator of one wheel; see the module's docstring.

    Args:
        parameters: how the ground is estimated.
    """

    def __init__(self, parameters: TerrainParameters | None = None) -> None:
        self.parameters = parameters or TerrainParameters()
        self._tables = shape_table(self.parameters.contact)[None]
        self._numbers = self.parameters.numbers()[None]

    def initial_state(self) -> TerrainState:
        """Return the state before the first reading."""
        return initial_state()

    def step(self, state: TerrainState, reading: WheelReading, dt: float) -> tuple[TerrainState, TerrainEstimate]:
        """Take one reading.

        Args:
            state: after the reading before; it is not changed.
            reading: what is known of the wheel now.
            dt: measured time since the reading before [s]; of the first one any.

        Returns:
            New state and estimate.

        Raises:
            TerrainError: a reading that is not finite, or dt is not positive; the caller keeps its state.
        """
        require_dt(dt)
        values = np.array(
            [[[
                reading.rolling_speed, reading.velocity, reading.force, reading.normal_force, reading.lateral_slip,
                reading.lateral_force,
            ]]]
        )  # fmt: skip
        if not np.isfinite(values).all():
            raise TerrainError(f"{reading!r} is not allowed; allowed: finite numbers")
        state = TerrainState(state.numbers.copy(), state.sums.copy(), state.history.copy())
        results = np.empty((1, 1, RESULTS))
        run_wheels(self._tables, self._numbers, state.numbers, state.sums, state.history, values, dt, 1, results)
        return state, estimate_of(results[0, 0])

    def run(self, readings: FloatArray, dt: float, every: int = 1) -> FloatArray:
        """Take a whole record (T, 6) of readings at a constant step, compiled.

        Returns:
            (T / every, RESULTS): mu_p, lambda_p, covariance of their logarithms (mu mu, mu lambda, lambda lambda), valid,
            misfit, index of the reason, number of changes, slip, friction, deviation of the slip, time since the last
            change, suspect. Zeros where nothing is known.
        """
        require_dt(dt)
        if readings.ndim != 2 or readings.shape[1] != 6 or not np.isfinite(readings).all():
            raise TerrainError(f"readings of shape {readings.shape} are not allowed; allowed: finite numbers, shape (T, 6)")
        results = np.zeros((-(-len(readings) // every), 1, RESULTS))
        state = self.initial_state()
        run_wheels(
            self._tables, self._numbers, state.numbers, state.sums, state.history, readings[:, None, :].copy(), dt, every,
            results,
        )  # fmt: skip
        return results[:, 0]
