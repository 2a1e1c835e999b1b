"""Every number of the estimator that decides something, with unit, meaning and origin."""

from __future__ import annotations

from models.measurement import numbers as measurement
from models.measurement.numbers import CONTACT_START, FALSE_ALARM_Z2, FIELD_START, SIGMAS, TINY, WHITE, Number

__all__ = ["CONTACT_START", "FALSE_ALARM_Z2", "FIELD_START", "SIGMAS", "TINY", "WHITE"]  # beside this module's own

GLANCE_Z2 = Number(36.0, "-", "the same at a first look", "derived: the whitening is 0.5 s old, 10 % of z")
GLANCE_S = Number(0.5, "s", "for which a whitening does for a first look", "derived: drift beyond is 1e-5")
SURER = Number(0.5, "-", "of a variance then, below which a whitening is made anew", "derived: 40 % of a sigma")
QUIET = Number(1.8, "-", "chi^2 a measurement of what nothing needs to explain", "derived: one of 120 in 5e6 scans")
GOOD = Number(1.45, "-", "the same of a fit that explains its scan", "derived: 3.5 sigmas of 120")
MOST = Number(2.5, "-", "the same of a fit that is roughly right: places hold", "chosen: 60 % more than the noise")
"""Is something there, and is it explained?"""

FIELD_WALK = Number(1e-5, "1/sqrt(s)", "log conductivity, even: its walk", "measured: drift of 4 %/min, 459 phantoms")
SLOPE_WALK = Number(3e-6, "1/sqrt(s)", "the same across the sheet", "derived: a third of FIELD_WALK")
FIELD_RATE = Number(2e-4, "1/s", "log conductivity, even: its rate at the tare", "derived: half a degree a minute")
SLOPE_RATE = 0.5 * FIELD_RATE  # 1/s: the same across the sheet
SLOPE_LASTS_S = Number(20.0, "s", "for which it goes on one way, unwatched", "derived: heat through 1 cm of foam")
FIELD_RATE_WALK = Number(2e-5, "1/s/sqrt(s)", "its walk", "measured: half a degree a minute is followed in 3 s")
SLOPE_RATE_WALK = Number(8e-6, "1/s/sqrt(s)", "the same across the sheet", "derived: 0.4 of FIELD_RATE_WALK")
FIELD_FASTER = Number(1e-3, "-", "faster drift than that, in one scan", "derived: ten sigmas of one measurement")
SLOPE_FASTER = 0.5 * FIELD_FASTER  # the same across the sheet
FASTER_STAYS = measurement.LEARNING  # of that variance, in value and rate from then on: 20 such scans
CONTACT_FASTER = Number(2e-3, "-", "faster change of a contact impedance in one scan", "derived: ten of CONTACT_WALK")
CONTACT_WALK = Number(2e-4, "1/sqrt(s)", "a contact impedance", "measured: drifts of 0.1 to 1 %/s, 0 to 1 phantom")
CONTACT_RATE = Number(8e-4, "1/s", "the same while nobody watches", "derived: a quarter in 5 minutes; skin.toml's own")
CONTACT_BENDS = Number(1e-3, "-", "of such a change: what its columns leave", "measured: 4e-4 at 30 %, EIDORS")
CONTACT_FOLLOWS = Number(0.1, "1/s", "of its flicker's variance that is slow", "measured: 1/f noise of 0.1 %")
REMAINDER_START = FIELD_START  # each measurement's own rest at the tare
REMAINDER_WALK = Number(2e-6, "1/sqrt(s)", "its walk", "chosen: a tenth of the noise in half a minute")
"""What drifts."""

MEMORY_FADES_S = (
    Number(2.0, "s", "fast time constant of foam's recovery", "measured: needed to a factor of 4 only"),
    Number(40.0, "s", "slow one", "measured: needed to a factor of 4 only"),
)
MEMORY_SHARE = Number(0.01, "-", "of a touch that stays, each state", "measured: 1 to 8 % (van der Schuur 2004)")
MEMORY_SD = Number(0.012, "-", "its standard deviation", "derived: of that range")
MEMORY_WALK = Number(0.5, "-", "of itself in a time constant", "chosen: no foam is exponential")
MEMORY_MOST = Number(0.05, "-", "share above which it is a touch, not memory", "chosen: the promise, below 1 to 8 %")
MEMORY_DOUBT_S = Number(3.0, "s", "after which a memory is not doubted any more", "derived: beyond the fast recovery")
MEMORY_FAINT = Number(0.5, "-", "of WHITE: a fainter memory is forgotten", "derived: half a sigma of a whole scan")
REFUSED_MOST = Number(0.5, "-", "change of |Z| that a touch makes at most", "derived: a drop of 1 under an electrode")
MEMORIES = Number(12.0, "-", "memories that are kept", "chosen: cost; more were never alive at once")
"""What foam remembers."""

MEMORY_APART = Number(0.7, "-", "of a radius: a place left by more remembers by itself", "chosen: half its area")
PLACE_MOVES = Number(0.08, "unit", "by which a place differs from the one expected", "derived: 4 mm, 0.3 m/s for 13 ms")
SAME_TOUCH = Number(0.15, "unit", "within which a touch found anew is the one before", "derived: 0.3 m/s, a scan")
BENDS = Number(0.13, "-", "of a change within a scan: error of its middle where it bent", "derived: KINK / 2 / 3")
ROUGH = Number(0.1, "unit", "place of a touch that changed and is not explained", "derived: 5 mm in a scan, 0.1 m/s")
STILL_SCANS = Number(3.0, "-", "scans without motion or change, after which a touch stays", "derived: of one in 1000")
PLACE_WALK = Number(0.003, "unit", "place of one that stays, from scan to scan", "derived: a third of STILL_WAY")
STAYS_WITHIN = Number(2.5, "-", "sigmas that one which stays is off at most", "derived: one scan of 25")
STILL_WAY = Number(0.01, "unit", "way within a scan of one that stays", "derived: 0.5 mm, 12 mm/s")
STILL_CHANGE = measurement.CHANGES  # of its action within a scan
RADIUS_WALK = Number(0.05, "-", "log radius from scan to scan", "chosen: a finger that rolls")
SHAPE_WALK = Number(0.3, "-", "of what shapes differ by, from scan to scan", "chosen: a finger that rolls")
SLIDES = Number(1.5, "unit/s", "velocity of a touch of which nothing is known", "derived: 75 mm/s, one sigma")
TURNS = Number(1.0, "unit/s/sqrt(s)", "its walk", "chosen: one that slides turns round in half a second")
ACTION_WALK = RADIUS_WALK  # of its action, from scan to scan, as it meets another
MEET_S = Number(2.0, "s", "for which two are kept apart by what they were", "chosen: a second or two of crossing")
GOES = Number(0.7, "-", "of its action, below which a touch is going", "chosen: above any relaxation")
ENDED = MEMORY_MOST  # of its greatest action, below which it has ended
PLACED = Number(0.06, "unit", "standard deviation of a new touch's place with which it is shown", "derived: 3 mm, near")
BROAD = Number(0.41, "unit", "radius of a new touch that may as well be two", "derived: 20 mm, 1.5 AREA_LOG_SD up")
TOLD = Number(20.0, "-", "values since a touch began, below which it may be two", "measured: 14 to 19 told one of two")
SURE_Z2 = FALSE_ALARM_Z2  # of a new touch that is shown
"""What touches do from scan to scan."""

ONSET_Z2 = Number(7.0, "-", "z^2 that a touch which began within a scan must have beyond", "derived: 2 ln of 33 onsets")
ANOTHER = Number(15.0, "nat", "evidence that a further touch adds in a part", "derived: 650 discs in 1e4 frames, and 2")
RECOUNT_GAIN = Number(5.0, "nat", "evidence of others than those that stand", "derived: one false in 150 first askings")
SEVERAL = Number(0.35, "-", "of what fewer discs leave: one more leaves less", "chosen: three tips, seeds 5, 11; 21")
GRID_MISSES = Number(0.005, "-", "energy of one disc that the grid leaves", "measured: 0.001 to 0.01 of presses")
ANOTHER_Z2 = Number(16.0, "-", "z^2 of a further disc that is tried by evidence", "chosen: 4 sigmas; evidence decides")
WIDE_START = Number(4.1, "nat", "log prior that a new touch's wide start lacks", "derived: places 1.9, actions 2.2")
LOG_PRIOR_TOUCH = Number(-3.5, "nat", "log prior of a touch that begins in a scan", "derived: one in 30 scans")
LOG_PRIOR_DRIFT = Number(-7.0, "nat", "of faster drift", "derived: one in 1000 scans")
LOG_PRIOR_MEMORY = Number(-1.0, "nat", "of memories as large as foam's may be", "derived: one touch in three")
LOG_PRIOR_BURST = Number(-3.0, "nat", "of a known disturbance that grew", "derived: one in 20 scans")
LOG_PRIOR_NOISE = Number(-20.0, "nat", "of blocks with a noise of their own", "derived: 2 nats for each of ten figures")
LOG_PRIOR_WIDE = Number(-2.0, "nat", "of a response that is wrong by MISFIT_WIDE", "derived: one touch in 7")
BURST = Number(8.0, "-", "times a known disturbance's strength", "chosen: a drive that switches on is 10 times")
MOST_NOISE = Number(4e-3, "-", "noise of a block under which a touch would still be seen", "derived: 1 N changes 1e-2")
NEIGHBOURS = Number(0.06, "unit", "gap below which two discs may be one touch", "derived: 3 mm, none nearer are told")
MOST_TOUCHES = Number(4.0, "-", "touches at once", "chosen: cost; image and contact frames hold more")
MOST_STEPS = Number(200.0, "-", "steps times touches of one scan, beyond which nothing new is asked", "chosen: 30 ms")
LEAST_BUDGET = Number(0.4, "-", "of them, for a part of a scan", "chosen: the parts after it are asked as well")
SEPARATE = Number(4.0, "-", "times that, of a scan that stands by itself", "chosen: four scans find any three touches")
FOR_FAULTS = Number(0.4, "-", "of them, for what the board may have done", "derived: two changes, two fits each")
STEPS_WARM = Number(4.0, "-", "steps of a fit from the scan before", "measured: 2 or 3 are used")
STEPS_COLD = Number(10.0, "-", "steps of a fit from a grid's disc", "measured: 4 to 10 are used")
ADRIFT = Number(1.5, "-", "by which faster drift grows with each unexplained scan", "derived: 2 s to a per cent")
MOST_ADRIFT = Number(1e4, "-", "at most, of its variance", "derived: ten per cent of the field")
"""What may explain a scan: log priors, and the budget."""

START_SIZES = Number(9.0, "-", "sizes of a difference between skin and bundle", "derived: up to 256 times the least")
START_FIELD = Number(0.05, "-", "log conductivity of an unknown sheet: over 1 unit, one way", "chosen: dries by 5 %")
START_CONTACT = Number(0.3, "-", "a contact impedance of an unknown skin", "derived: as the networks were trained")
START_SERIES = Number(0.03, "-", "a contact's part in series, against its rest", "measured: trust --plan drift")
START_ABSOLUTE = Number(3e-5, "-", "what no model of |Z| gets right", "measured: two meshes of one skin")
START_COST_WIDE = Number(-2.3, "nat", "of a sheet that is uneven", "derived: one skin in ten")
START_SEEN = Number(0.0063, "unit^2", "action of the touch that must not hide", "derived: half a newton, 10 mm radius")
START_SEEN_SHARE = Number(0.2, "-", "of the places and sizes where it may", "chosen: four of five are seen")
START_TOUCHES = Number(3.0, "-", "touches at a start at most", "measured: with 4 world all is touched at its start")
START_NATS = Number(30.0, "nat", "by which a touch explains the first scans better", "measured: tests of the start")
START_SURE = Number(16.0, "-", "times the least difference beside which a touch is sure", "measured: as START_NATS")
"""What a skin may be before its first baseline."""

TARE_SCANS = Number(64.0, "-", "scans of a baseline", "derived: an eighth of one scan's noise")
TARE_RETRIES = Number(8.0, "-", "scans after which a first baseline is tried again", "chosen: cost")
TARE_QUARTERS = Number(4.0, "-", "parts of them that must agree", "chosen: a press of a second is one")
TARE_DISAGREES = Number(1e-5, "-", "probability that quiet scans are refused", "chosen: once in a year of starts")
TARE_HARMLESS = 0.5 * WHITE  # change within them that does no harm
TARE_NOISY = Number(0.05, "-", "noise beyond which no touch could be told", "chosen: the weakest touches' change")
TARE_UNTRAINED = Number(0.0056, "-", "noise beyond which no network was trained", "derived: 45 dB, models/augmentation")
TARE_DRIFTS = Number(3e-3, "-", "log conductivity, change while they come", "derived: a degree in 3 s")
TARE_JUMPS = Number(0.03, "-", "of a contact impedance, while they come", "chosen: a touch of 0.03 N on an electrode")
AGES = (
    Number(0.0, "-", "of a baseline's age, that its skin has drifted by: as if just taken", "derived: the least"),
    Number(0.1, "-", "the same: a tenth as far as its rates say", "derived: half way, in decades, to noise"),
    Number(1.0, "-", "the same: as far as its rates say", "derived: the most"),
)
YOUNGER = Number(10.0, "nat", "by which less drift wins, per further touch", "chosen: by 30, 7 of 80 rows are worse")
OLDEST_S = Number(600.0, "s", "age of a baseline beyond which it is no older", "derived: FIELD_RATE makes 12 % of it")
TARE_IDENTICAL = Number(1e-12, "-", "noise below which scans are the same", "derived: arithmetic of their mean")
TARE_ASSUMED = Number(1e-3, "-", "noise where scans tell none", "chosen: 60 dB, ten times the board's")
LAG_SCANS = Number(2.0, "-", "scans that one waits to be believed untouched", "derived: they show a ramp of 150 ms")
STRANGE = Number(0.1, "-", "of a scan left by touches, from which on it is of none", "chosen: odd touches leave 0.02")
TOUCHED_LEARNS_S = Number(1.0, "s", "after which drift is learnt beside touches", "chosen: a fidgeting finger's own")
SLOW_S = Number(10.0, "s", "after which a slow press is told from drift", "chosen: half of the slowest press")
SLOW_EVERY_S = Number(1.0, "s", "from look to look for one", "chosen: cost, 4 ms")
SLOW_TIMES = Number(400.0, "-", "times FIELD_FASTER^2: drift meanwhile", "derived: contacts 4 %, 5 times CONTACT_RATE")
CHANGING_S = Number(0.1, "s", "for which what nothing explains is said to be changing", "derived: two whole scans")
LOST_S = Number(1.0, "s", "of nothing that explains it, after which no touch is vouched for", "derived: half of 2 s")
LOST_SCANS = Number(8.0, "-", "whole scans from search to search then", "chosen: cost, three searches a second")
GAP_S = Number(0.13, "s", "without a scan, after which touches may be anywhere", "derived: three whole scans")
DOUBT_Z2 = Number(400.0, "-", "z^2 of a touch that every whole scan asks whether it is drift", "derived: 20 sigmas")
DOUBT_SCANS = Number(10.0, "-", "whole scans after which every touch is asked that", "derived: twice a second")
ODD_OUTLINE = Number(12.0, "-", "squared sigmas of an outline that may be several", "derived: 9 figures, 1.5 sd")
ODDER = Number(1.5, "-", "times as odd as when it was asked last: it is asked again", "chosen: cost")
SURE_SCANS = Number(2.0, "-", "whole scans that need a weak touch, after which it is shown", "derived: a chance twice")
LEAST_LIVE = Number(0.5, "-", "share of the measurements that must count", "chosen: half, to see a touch anywhere")
"""The way of one scan."""

SHORT_OHM = Number(1e-3, "ohm", "between electrodes whose wires touch, of a sheet of 1 S", "chosen: any small one")
NEXT_TO_NOTHING = Number(0.05, "-", "of the median |Z|: a fault leaves nothing to see", "derived: 20 times the noise")
OPEN_SHARE = Number(0.8, "-", "of an open electrode's measurements: they fail", "chosen: half more than of others")
FAR = Number(10.0, "-", "times its prediction, or its inverse: a failed measurement", "derived: no touch or contact")
FALLS = Number(0.03, "-", "relative fall that no touch, warmth or noise makes", "measured: as the wiring of before")
MISFIT_MOST = Number(10.0, "-", "times FALLS, beyond which a misfit counts no more", "chosen: a third")
LOG_PRIOR_WIRE = Number(-16.3, "nat", "log prior of a fault of the wires", "derived: one in 1e5 scans, 120 couples")
LOG_PRIOR_FAILURE = Number(-14.5, "nat", "of a measurement that fails for no reason", "derived: one in 2e6")
LOG_PRIOR_EXPECTED_FAILURE = Number(-3.0, "nat", "of one that a fault leaves nothing of", "derived: one in 20")
WIRE_SURE = Number(30.0, "nat", "by which a fault of the wires must be likelier", "chosen: true ones win by hundreds")
WIRE_APART = Number(10.0, "nat", "by which it must be likelier than another one", "derived: one error in 2e4")
"""Wires."""

SHORT_WAY = Number(4.7, "-", "rest of a contact against its series part: b = a / (1 + a / 4.7)", "measured: square16")
SHORT_WAY_SD = Number(0.12, "-", "of b, relative", "measured: 1 to 6 % on the stub's mesh, 12 % on another board's")
REST_FLOOR = Number(0.01, "-", "of b, where nothing changes", "derived: a tenth of what is named")
CONTACT_CHANGES = Number(1.5, "-", "change of a contact impedance, one sigma", "derived: up to 9 times is 5 of it")
CONTACT_MOST = Number(100.0, "-", "its change at most: beyond it is open", "derived: more than any pair's own")
COURSE_FLOOR = Number(0.02, "-", "its change within a scan, at least", "derived: 10 % a second, and 0.5")
CONTACTS_EXACT = Number(6, "-", "changes of contacts fitted exactly", "derived: the likeliest, and its rivals")
CONTACT_MISFIT = Number(2e-3, "-", "what its columns get wrong, relative", "measured: 0.5e-3 at 8 times, stub's mesh")
GAIN_CHANGES = Number(0.1, "-", "log of a gain's step, one sigma", "data sheet: AD5940, RTIA and PGA")
GAIN_LEAST = Number(5e-4, "-", "log of a gain's step that is one", "derived: five sigmas; drift explains smaller ones")
LOG_PRIOR_CONTACT = Number(-14.3, "nat", "of a contact that changes", "derived: one in 1e5 scans, 16 electrodes")
LOG_PRIOR_GAIN = Number(-9.2, "nat", "of a gain that steps", "derived: one in 1e4 scans")
FAULT_SURE = Number(8.0, "nat", "by which one, or a touch on an electrode, is likelier", "derived: one error in 3000")
CONTACT_WALK_CHANGED = Number(0.1, "-", "walk of a changed contact in a scan, of itself", "measured: 9 times in 6.5 s")
CONTACT_STILL = Number(0.01, "-", "step in a scan, of itself, when settled", "derived: 0.1 CONTACT_WALK_CHANGED")
CONTACT_SETTLES_S = Number(10.0, "s", "still for so long it is the skin's own", "chosen: named long enough to be read")
CONTACT_BACK = Number(0.004, "-", "change below which a contact is well again", "derived: ten sigmas of the filter's")
BACK_SCANS = Number(3.0, "-", "whole scans for which it must be", "chosen: a loose wire flaps no faster")
CONTACT_DECIDED = Number(24.0, "nat", "by which a contact is likelier than a touch", "measured: light touches reach 18")
TOUCH_SECOND = Number(4.0, "1/unit^4", "what a touch does to its electrode, of its action squared", "measured: 4 A^2")
CONTACT_PLAIN = Number(0.5, "-", "change that is named at once", "measured: touches on electrodes reach 0.35")
PACE_S = Number(0.8, "s", "for which a contact that drifts goes on steadily", "chosen: a press takes less to come")
PACE_LEAST = Number(0.02, "-", "of its impedance, least change in that time", "derived: 2.5 % a second")
PACE_BENDS = Number(0.15, "-", "of the way, from a straight line", "chosen: as the service before")
PACE_UNSEEN = Number(0.01, "1/s", "pace of a contact that is followed unsaid", "measured: drifts of 0.1 to 1 %/s")
PACE_GROWS = Number(2.0, "-", "times its pace that a contact may drift", "chosen: as it turns round")
UNDECIDED_SETTLES_S = Number(60.0, "s", "still so long, what may be a touch is the skin's", "chosen: nobody rests so")
GAIN_Z2 = Number(25.0, "-", "squared sigmas that all values share, from which a gain's step is asked", "derived: 1e-6")
GAIN_GROSS = Number(0.14, "-", "log of a step that no sound board's gain makes", "data sheet: RTIA and PGA, a tenth")
GAIN_BACK = Number(0.01, "-", "log of what is left of it when it ends", "derived: drift of a minute")
CONTACT_UNSURE = Number(0.02, "-", "of a contact that has just changed, of itself", "derived: a fifth of its walk")
ON_ELECTRODE = Number(0.2, "unit", "gap below which a touch changes an electrode's contact", "derived: its width")
ACTS_Z2 = SIGMAS**2  # squared sigmas of a touch's action, below which it may be none
SMALL = ON_ELECTRODE  # radius of a touch that may be an electrode's contact
LOG_PRIOR_SMALL = Number(-8.0, "nat", "log prior of such a touch on an electrode", "derived: its share of the sheet")
COUNT_DOUBTS = (1, 2, 8, 24)  # whole scans of a touch, after which it is asked whether it is several
CHANGE_ROWS = 2 * measurement.BURST_BLOCK  # least measurements since a change: two parts; one is as well a touch
STANDS_WAY = Number(0.02, "unit", "way of a touch that stands, in a scan", "derived: 1 mm")
STANDS_SHARE = Number(0.2, "-", "its change of size and of action", "derived: a finger that presses harder for a scan")
UNEXPLAINED_SCANS = Number(3.0, "-", "scans after which a fault that explains nothing goes", "measured: six lock-ins")
"""Contact impedances and gain."""

SILENT = Number(0.7, "-", "share of measurements that fail where it is not electrodes", "derived: more than any bit's")
DEGRADED = Number(2.0, "-", "electrodes at fault that a frame says", "chosen: as the service before")
TOO_MANY = DEGRADED + 1  # electrodes at fault with which no frame is valid
"""What a board's faults leave."""
