"""PDM-Closed: fifteen ways to go on, simulated and scored, and the best one is driven.

Dauner, Hallgarten, Geiger, Chitta, Parting with Misconceptions about Learning-based Vehicle Motion Planning,
CoRL 2023, and its public implementation (tuplan_garage). Three paths (the middle of the lane and one metre
to either side) times five IDM drivers (0.2 to 1.0 of the speed limit) make proposals over 4 s. Each is
driven by nuPlan's LQR tracker and kinematic bicycle, and scored on contacts by its own fault, drivable area,
direction, progress, time to collision and comfort against a forecast of everybody at constant speed along
its heading. Who stands in front of a contact brakes.

By default a few things differ from the public implementation, whose conventions `strict_tuplan` brings back:

=====================  ====================================  =======================================
                       default                               strict
=====================  ====================================  =======================================
leader at the start    known                                 none: all brake hard for 0.1 s
speed                  not below 0                           may fall below 0 for a moment
standstill gap         2 m; who is nearer brakes hard        1 m; who is nearer brakes as at that gap
braking limit          6 m/s^2 behind others, else 3         3 m/s^2
speed limit            where the proposal is by then         of the lane at the start
path                   led from where the vehicle is,        one metre aside at once
                       with all of the body on the road
required lane change   a path in the lane beside replaces    none: stands at the end of the lane
                       one of the three, minds those behind,
                       too, and signals
lights                 red, and yellow that one can obey     red
edge of the road       0.1 m of the 0.3 m that nuPlan's      to the centimetre
                       own metric allows
profiles to track      those of the IDM and of the path      least squares over the poses
errors in bends        against the path beside the vehicle   against the pose of that time
bicycle                the simulator's                       nuPlan's (Euler steps)
scores                 equal within 0.001                    exact
emergency braking      at any speed, 7 m/s^2 along the       up to 5 m/s, poses straight on at a
                       proposal                              corrected speed
=====================  ====================================  =======================================

Paths are laid anew at every decision, in both.
"""

from limsim_jax.policies.pdm.learned import PDMHybrid as PDMHybrid
from limsim_jax.policies.pdm.policy import PDMClosed as PDMClosed
