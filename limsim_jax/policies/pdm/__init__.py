"""PDM-Closed: fifteen proposals are simulated and scored, and the best one is driven.

Dauner, Hallgarten, Geiger, Chitta, Parting with Misconceptions about Learning-based Vehicle Motion Planning,
CoRL 2023, and its public implementation (tuplan_garage). Three paths (the middle of the lane and one metre
to either side) times five IDM drivers (0.2 to 1.0 of the speed limit) make proposals over 4 s. Each is
driven by nuPlan's LQR tracker and kinematic bicycle. It is scored on at-fault contacts, drivable area,
direction, progress, time to collision and comfort, against a forecast of all other vehicles at constant
velocity. If the best proposal still leads to a contact soon, the vehicle brakes.

It sees positions, headings and speeds of the others, and lights. It knows no routes, driver parameters, turn
signals or right of way. `PDMClosed(rules=True)` gives way as the map demands, see `pdm.give_way`.

By default a few things differ from the public implementation. `strict_tuplan` restores its conventions:

=====================  ====================================  =======================================
                       default                               strict
=====================  ====================================  =======================================
leader at the start    known                                 none: all brake hard for 0.1 s
speed                  not below 0                           may fall below 0 for a moment
standstill gap         2 m; hard braking below it            1 m; the braking of that gap below it
braking limit          6 m/s^2 behind others, otherwise 3    3 m/s^2
speed limit            at the position of the proposal       of the lane at the start
path                   from the position of the vehicle,     one metre aside at once
                       with the whole body on the road
required lane change   a path on the adjacent lane replaces  none: stops at the end of the lane
                       one of the three; it considers
                       followers, too, and signals
lights                 red, and yellow if stopping is easy   red
edge of the road       0.1 m of the 0.3 m that nuPlan's      to the centimetre
                       own metric allows
profiles to track      those of the IDM and of the path      least squares over the poses
errors in bends        against the nearest path point        against the pose of that time
bicycle                the simulator's                       nuPlan's (Euler steps)
scores                 equal within 0.001                    exact
emergency braking      at any speed, 7 m/s^2 along the       up to 5 m/s, straight poses at a
                       proposal                              corrected speed
=====================  ====================================  =======================================

In both, paths are computed anew at every decision.
"""

from limsim_jax.policies.pdm.learned import PDMHybrid as PDMHybrid
from limsim_jax.policies.pdm.policy import PDMClosed as PDMClosed
