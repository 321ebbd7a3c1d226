/* A robot's policy: from its observation to its motion. C99, float only, no heap.
 *
 * Written by swarmjax.export; has the same numbers as policy.npz with digest
 * $digest.
 * $kind
 *
 * Observation, each entry (quantity - offset) / scale:
 *
$observation
 *
 * Command, each entry within low and high:
 *
$action
 *
 * Trained for: $trained,
 * a command every $control_step s.
 */
#ifndef POLICY_H
#define POLICY_H

#define POLICY_OBSERVATIONS $observations
#define POLICY_ACTIONS $actions
#define POLICY_LEARNERS $learners

#define POLICY_DIGEST "$digest"
#define POLICY_CONTROL_STEP $control_step_f /* s */
#define POLICY_TARGET_RADIUS $target_radius_f /* m, distance to the target that counts as arrival */
#define POLICY_HOLDS $holds /* 1: it keeps driving within that distance; 0: stop the robot there for good */

$memory_type/* Scales quantities, in the units above, to an observation. */
void policy_observe(const float quantity[POLICY_OBSERVATIONS],
                    float observation[POLICY_OBSERVATIONS]);

/* Computes the most likely action; -1..1 spans the commands, but it may lie beyond. `learner` is
 * the robot's number, modulo POLICY_LEARNERS: any number will do if all robots share the policy. */
void policy_action(unsigned learner, const float observation[POLICY_OBSERVATIONS],
                   ${memory_parameter}float action[POLICY_ACTIONS]);

/* Draws an action from the policy around the most likely one, as in evaluation. `normal` are
 * standard normal numbers, independent of each other and of earlier ones. Random actions free
 * robots that would block each other with their most likely actions. */
void policy_sample(unsigned learner, const float normal[POLICY_ACTIONS],
                   float action[POLICY_ACTIONS]);

/* Scales an action, clipped to -1..1 first, to forward speed (m/s) and turn rate (rad/s, left
 * positive). */
void policy_command(const float action[POLICY_ACTIONS], float command[POLICY_ACTIONS]);

/* Turns a command into the speeds of the left and the right wheel (rad/s), each within its limit:
 * wheel radius $wheel_radius m, track $track m, limit $max_wheel_speed rad/s. */
void policy_wheel_speeds(const float command[POLICY_ACTIONS], float wheels[2]);

#endif
