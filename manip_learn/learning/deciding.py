"""The numbers that decide what is learnt, and what an audit says: one place for the whole room.

A number stands here if another value of it can change an answer: what is accepted or refused, told apart, chosen,
warned of or stated. Each has its unit and the reason for its value with where that comes from; what half and twice its
value change on a panel of recordings stands in docs/constants.md (`python benchmarks/half_and_double.py`). "Set by
hand" says that there is no derivation and no study of it. "Share" and "ratio" have no unit. What bounds time and
memory, and what is rounding, stands beside the code that it serves.
"""

# --- motion and noise ---

# [s] samples closer together than this tell the same story, and a change of what is held takes as long, over which
# velocities are smoothed: a person's motion does not change faster. Set by hand
CHANGE_SECONDS = 0.1
# [s] the largest step of time that counts in full: a gap in a recording is no evidence. Set by hand
LONGEST_STEP_SECONDS = 0.2
# directions, or samples, that a smooth motion fills of a window: a cubic has four parameters
CUBIC = 4
# [standard deviations of the noise] beyond which it is motion: the range of a random walk exceeds 4 in one of 10,000
# trajectories, and so does a sample in one of 15,000
OVER_NOISE = 4.0
# ratio to the usual speed, or distance from the middle, beyond which a sample is a fault of the recording. Set by hand
OUTLIER_FACTOR = 1e4
# share of the motion's energy below which something counts as still: a thousandth of the velocity. Set by hand
STILL_ENERGY = 1e-6
# [joints] fewer than this that move at a time, in the mean, is how a hand-guided arm with stiction moves. Set by hand
FEW_JOINTS_AT_ONCE = 1.6
# [joints] a joint that moves alone goes where it must: only joints that move at the same time show what coordinates
# them. Joints that are moved one after the other give 1.00, contacts of twelve mechanisms with four arms 1.4 to 4
# (least 1.1)
JOINTS_AT_ONCE = 1.1
# [rad/s or m/s] of the fastest joint, below which it is at rest: encoder noise of 1e-4 rad at 100 Hz looks like 0.014
REST_SPEED = 0.02
# trajectories, below which nothing is clear: of two that differ one cannot say which is the odd one
FEWEST_TRAJECTORIES = 3

# --- evidence and states ---

# share of a held phase's samples that may be far off (slips, knocks): bounds the evidence against it. Set by hand
FAR_OFF_SHARE = 0.02
# [nats] that a change between two states costs: a person changes every few seconds, a chance of exp(-16) for one of
# the ten samples of a second is that of a change in some months
SWITCH_NATS = 16.0
# the scales among which a hypothesis takes the one with the most evidence, about half a decade apart: the standard
# deviation of what breaks it over the noise's
HELD_STEADY = (1.0, 3.0, 9.0)
# the same, share of the motion
HELD_SHARES = (0.003, 0.01, 0.03, 0.1, 0.2)
# [nats] least gain of a hypothesis, without its best supporter and after the price of its parameters. Set by hand, on
# sets with seeds below 20000
LEAST_GAIN_NATS = 40.0
# samples that determine rows, for each direction of the features. Set by hand
SAMPLES_PER_DIRECTION = 3
# [s] a stretch shorter than this is chance; as much at either end of a longer one may have left it. Set by hand
SHORTEST_STRETCH_SECONDS = 0.3
# ratio to the usual distance, or drift, along the held rows beyond which they are not held: in 50 sets of recordings
# that all agree the largest drift was 3 times the usual one
FAR_FROM_HELD = 2.5
# ratio to the usual length of a stretch, below which one is chance: another motion that passes along the free
# directions. Set by hand
SHORT_STRETCH_RATIO = 0.25
# largest share of the free velocity along the rows of a firm contact. Set by hand
FIRM_SHARE = 0.05
# the same in a single recording, where only firmness tells a contact from free motion, which also runs straight or
# flat, but never to better than a few per cent
FIRM_ALONE_SHARE = 0.01
# [deg] rows of two constraints closer together than this may be one constraint, or two. Set by hand
NEARLY_SAME_DEG = 5.0

# --- proposals ---

# [s] lengths of the windows that propose rows; from the shortest the noise of the velocities is told, too. Set by hand
SHORT_WINDOWS_SECONDS = (0.6, 1.2)
# [s] lengths of windows that are taken in pairs, for one on a curved surface fits many rows. Set by hand
LONG_WINDOWS_SECONDS = (1.2, 2.0)
# ratio of the next level to the s-th from which a window proposes s rows. Set by hand
PROPOSAL_GAP = 2.5

# --- recombination ---

# chance of at least the evidence seen, were the joints independent of each other, that a row may have. Convention
ROW_CHANCE = 0.01
# growth of a row's motion by recombination, exceeded with 99 % confidence and the choice paid for, from which it is
# believed to be held, and from which it is so beyond doubt. Free motion is coordinated, too: the best of 60 sets of
# generated free motion reaches 1.6 (seeds 22000 to 22009), free motion of a real arm that replays itself 1.97; a curved
# part wiped by hand 1.97, contacts with rails, hinges and tables 15 to 500. At half of it 11 of the 60 free sets would
# be answered, at twice the curved part would not
BELIEVED_STRENGTH, CLEAR_STRENGTH = 1.8, 4.0
# least strength of a row that is ranked before one found held: noise spreads unevenly, the first row has the least.
# Set by hand
LEANING_STRENGTH = 1.3
# share of the most used direction's motion below which a direction was not tried. Set by hand
USED_SHARE = 1.0 / 6.0
# share of the liveliest joint's motion below which a joint does not set the phase: its noise would. Set by hand
PHASE_JOINT_SHARE = 0.3
# [s] that one bin of the phase should cover, and the least number of bins. Set by hand
BIN_SECONDS, FEWEST_BINS = 0.25, 4

# --- odd recordings and stretches ---

# [robust standard deviations of the logarithm] by which a drift must exceed the usual one to be odd. Set by hand
ODD_SPREAD = 6.0
# share of its motion by which a stretch must drift to be odd. Set by hand
ODD_SHARE = 0.005
# [s] longest interruption of a contact: who lets go for longer does so on purpose. Set by hand
LONGEST_SLIP_SECONDS = 1.5
# a slip goes this many times farther along the held rows than a whole contact, and at least this far [m or rad]. Set
# by hand
SLIP_FACTOR, LEAST_SLIP = 5.0, 2e-3
# share of the recordings that must show a constraint before one that does not is called odd: more than half
SHOWN_BY_SHARE = 0.6

# --- repeats ---

# [rad] two passes of one path are as near as this to each other: arms repeat a posture to 0.1 mm at half a metre
REPEATED_RAD = 2e-4
# distance over what noise and chords allow, up to which a posture lies on a path: the noise of seven joints reaches
# twice its root mean square once in 5,000 samples, that of two joints once in 50
LIES_ON_PATH = 2.0
# least share of a recording's way that lies on another's: copies are trimmed by a few samples at their ends
REPEATED_SHARE = 0.9
# largest distance that may be allowed, over the extent of the path; where noise or long chords exceed it nothing can be
# told. Of 28 kinds of generated sets, whole and cut (6 recordings, 4 arms, no noise, seeds 30000 to 30003), the nearest
# two are 3.6 % of their extent apart in reaches that are repeated, 6.7 % in contacts
NEAREST_PATH_SHARE = 0.01
# steps that the end of one piece may be from the beginning of the next: one without noise, where noise is as large as a
# step as often as not two
SEAM_STEPS = 3.0
# what a cubic leaves at a seam over the most that it leaves elsewhere; 1.25 and 1.5 tell the same of 256 sets
# (benchmarks/repeated_recordings.py, seeds from 30100)
SEAM_ROUGHNESS = 2.0
# what it leaves over the way through the seam, above which nothing moves there: noise alone leaves 0.6
SEAM_LEFT = 0.25
# speed at a seam over the mean one, above which a motion was cut rather than ended: the last 10 of 200 samples of a
# motion that comes to rest have 0.03
SEAM_SPEED = 0.2
# mean step over the extent of a recording, above which samples are no path: it is 0.5 for postures at random, 0.1 for
# ten samples of a straight motion
PATH_STEP = 0.25

# --- velocities ---

# how far a joint's recorded velocity may be off its positions, as a factor: at one joint 1.05 turns a drawer's rows by
# 0.7 degrees (median; 3.2 at worst), 1.2 by 2.6 (12); 8 sets of 4 arms, seeds 20000 to 20007
VELOCITY_SLOPE = 1.05
# correlation c of displacements with integrated velocities above which a joint is judged: in the 20 windows of a
# recording noise moves a slope by sqrt(1 / c^2 - 1) / sqrt(20), 5 % at 0.98
VELOCITY_CORRELATION = 0.98

# --- number of rows ---

# ratios of singular values, noise directions against free ones, that are clear, and weak. Set by hand
CLEAR_GAP, WEAK_GAP = 10.0, 3.0
# root mean square of residuals over that of the noise, from which it is more than noise: the ratio of the energies,
# 1.69, is three standard deviations sqrt(2 / n) of a variance that is estimated from n = 38 samples. The joint
# estimator's gap compares residuals of whole fits, in which noise enters both: it is weak from here
RESIDUAL_RATIO = 1.3
# ratio of joint estimates' gap, beyond which the null-space estimator's answer to the same data is not asked for
BEYOND_DOUBT_GAP = 30.0
# share of the motion's energy that breaks A u = 0 below which the rows are held beyond doubt, so that no other
# explanation is tried: a hundredth of the velocity; and above which they are called soft: a tenth. Set by hand
HELD_ENERGY, SOFT_ENERGY = 1e-4, 1e-2
# ratio up to which two answers are equally good, so that the first feature map and the simpler model are taken. Set
# by hand
EQUALLY_GOOD = 1.1
# share of the root mean square of u that is noise enough: what is resolved below it, in recordings without noise, is
# how well a model approximates the policy, and with more rows every model comes closer. Set by hand
RESOLVED_SHARE = 1e-3
# variance over that of the noise up to which a fit leaves noise alone: 22 % in amplitude. Set by hand
ABOVE_NOISE = 1.5
# share of the motion along a direction that a rich policy model must leave for the direction to be the task's: half
NOT_THE_POLICYS = 0.5
# left-out motion over that of no policy at all up to which a model predicts it: 1 where there is noise alone to predict
PREDICTS_NOISE = 1.2
# root mean square distance from a path over its extent within which a motion repeats it: replays with 3 % of another
# motion in them have 0.05 to 0.14, generated reaches in threes and more 0.32 and above (12, 192 sets, seeds from 30000)
SAME_PATH = 0.15

# --- policy model ---

# share of what a simpler model leaves that a richer one may leave to explain it: a policy beside the mean motion, which
# has no posture in it, on left-out trajectories; offsets of each trajectory beside none. Set by hand
EXPLAINED = 0.3
# held-out share of the energy below which a model is as good as exact: it is believed unasked, and extrapolation no
# longer decides between models. Set by hand
PREDICTED = 1e-3
# share of left-out motion that no model explains from which a weak gap may be the policy's. Set by hand
POORLY_EXPLAINED = 0.03
# ratio of the held-out cost by which a richer model must lower it to be worth its parameters. Set by hand
WORTH = 0.8

# --- chance and size of models, noise ---

# standard errors of a difference, an autocorrelation or a curvature that are more than chance: 95 %
STANDARD_ERRORS = 2.0
# the same beyond doubt: of a radius or a pitch, and of the chi-square that tells unequal noise; one in 3 million
BEYOND_CHANCE = 5.0
# how many times the regressors of the best a richer model may have. Set by hand
ONE_DEGREE = 3.0
# residuals for each of its parameters that make a richer model cheap. Set by hand
CHEAP = 25.0
# residual variance over that of a smaller model that is not chance with `RESIDUALS_PER_PARAMETER`. Set by hand
CLOSER = 0.9
# residuals, or samples, for each parameter or centre of a model: a rule of thumb of regression
RESIDUALS_PER_PARAMETER = 10
# degree up to which every policy is thought possible. Set by hand
MOST_LIKELY_DEGREE = 3
# largest variance of a joint's noise over the least below which equal weights cost a few per cent at most
UNEQUAL_NOISE = 2.0
# residuals for each entry of the noise's covariance, below which it is not estimated. Set by hand
RESIDUALS_PER_ENTRY = 20
# variances of the joints' noise beside their mean stay between these. Set by hand
NOISE_RANGE = (1e-2, 1e2)
# centres of the radial policy models of the joint estimator and, at least and at most, of the separation. Set by hand
RADIAL_CENTRES, FEWEST_CENTRES, MOST_CENTRES = 32, 4, 96

# --- mechanisms ---

# [m] beyond this an axis or a centre is not told from a line or a plane. Set by hand
FARTHEST_M = 3.0
# [m] by which a path must leave a simpler mechanism: rails wobble. Set by hand
LEAST_BEND_M = 5e-5
# one standard deviation above which a fit of a place is no answer: relative to the radius, and [deg]. Set by hand
POOR_RADIUS, POOR_AXIS_DEG = 0.2, 5.0
# uncertainty of the radius, relative, that is worth a warning; a third of it is aimed at. Set by hand
WIDE_RADIUS = 0.015
# residuals below these do not count as better: what hardware holds. Set by hand
SMALLEST_RESIDUAL = {"m": 2e-5, "rad": 4e-5}
# a quantity is the same for all trajectories if its residual grows by less than this ratio. Set by hand
SHARED_LOSS = 1.15
# standard errors by which the scatter over trajectories must exceed its expectation to count. Set by hand
SCATTER_ERRORS = 1.5
# share of the mean variance of a quantity that every sample has besides: hardware does not hold to nothing
VARIANCE_FLOOR = 0.05

# --- uncertainty ---

# share of the cases in which the truth lies within a stated angle, and within what is stated of a mechanism's place:
# one standard deviation of a normal error, 0.683, in two roundings; one of them would change stated numbers by 0.7 %
STATED_SHARE, STATED_SHARE_OF_PLACES = 0.68, 0.683
# [deg] 68 % within this angle is no answer: of all directions in space 13 % are as close to any
MOST_UNCERTAIN_DEG = 30.0
# [rad] offsets of the joints' zeros to be thought of: from an encoder's rounding to what the eye sees
OFFSET_RANGE_RAD = (1e-6, 3e-2)
# odds beforehand of no offsets: strong evidence for them is wanted (Kass and Raftery, 1995). At even odds 11 of 180
# sets of drawers with 1e-3 rad of noise alone got stated angles three times too wide (100 Hz, seeds from 30000)
NONE_TO_SOME = 20.0
# mean square of the effort in contact over that left in free motion below which less than half of it is contact
EFFORT_STANDS_OUT = 2.0

# --- audit ---

# chance that an audit of equally good episodes leaves any of them out, and that rows at random reach a share of effort
# that is shown beside that of the rows. Convention
FALSE_ALARMS = 0.05
# z-score: Iglewicz and Hoaglin, How to Detect and Handle Outliers (1993)
SMALLEST_THRESHOLD = 3.5
# episodes, below which no spread can be told. Set by hand
FEWEST_EPISODES = 5
# spread below which differences do not matter: 10 %, and 5 points of a share. Set by hand
LOG_SPREAD, SHARE_SPREAD = 0.1, 0.05
# values below which differences do not matter: the smallest singular value that is told from zero; a share of the
# motion, [mm], [deg], a share of the velocity limit, [rad/s^3], [s]. Set by hand
NEGLIGIBLE = {
    "singularity": 1e-6,
    "violation": 0.01,
    "displacement": 1.0,
    "rotation": 0.2,
    "speed": 0.1,
    "jerk": 1.0,
    "duration": 1e-3,
}
