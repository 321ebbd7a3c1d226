/* A robot's policy: from its observation to its motion. C99, float only, no heap.
 *
 * Written by swarmjax.export; has the same numbers as policy.npz with digest
 * {{ policy.digest }}.
 * {{ 'All robots share it.' if policy.is_shared else '%s policies, one for each robot.' % policy.mean | length }}
 *
 * Observation, each entry (quantity - offset) / scale:
 *
{% for name, unit, offset, scale in entries %}
 *   [{{ loop.index0 }}] {{ "%-20s %-8s" | format(name, unit) }} offset {{ offset | short }}, scale {{ scale | short }}
{% endfor %}
 *
{% if meta.sensors.poses is defined %}
 * Infrared sensors: place in the robot's frame, x forward and y left, and direction,
 * counter-clockwise from x:
 *
{% for x, y, yaw in meta.sensors.poses %}
 *   infrared_{{ loop.index0 }}: {{ x | short }}, {{ y | short }} m, {{ yaw | short }} rad
{% endfor %}
 *
{% endif %}
 * Command, each entry within low and high:
 *
{% for name in meta.action.names %}
{% set i = loop.index0 %}
 *   {{ "%-20s %-8s" | format(name, meta.action.units[i]) }} {{ meta.action.low[i] | short }} to {{ meta.action.high[i] | short }}
{% endfor %}
 *
 * Trained for: {{ trained }},
 * a command every {{ meta.task.control_step | short }} s.
 */
#ifndef POLICY_H
#define POLICY_H

#define POLICY_OBSERVATIONS {{ entries | length }}
#define POLICY_ACTIONS {{ meta.action.names | length }}
#define POLICY_LEARNERS {{ policy.mean | length }}

#define POLICY_DIGEST "{{ policy.digest }}"
#define POLICY_CONTROL_STEP {{ meta.task.control_step | float32 }} /* s */
#define POLICY_TARGET_RADIUS {{ meta.task.target_radius | float32 }} /* m, distance to the target that counts as arrival */
#define POLICY_HOLDS {{ 1 if meta.task.arrival == 'hold' or meta.task.get('goal', 'navigate') != 'navigate' else 0 }} /* 1: it keeps driving within that distance; 0: stop the robot there for good */

{% if memory %}
#define POLICY_MEMORY {{ memory }}

/* The memory of a robot. */
typedef struct {
    float recalled[POLICY_MEMORY];
} PolicyMemory;

/* Clears the memory, as at the start of an episode. */
void policy_begin(PolicyMemory *memory);

{% endif %}
/* Scales quantities, in the units above, to an observation. */
void policy_observe(const float quantity[POLICY_OBSERVATIONS],
                    float observation[POLICY_OBSERVATIONS]);

/* Computes the most likely action; -1..1 spans the commands, but it may lie beyond. `learner` is
 * the robot's number, modulo POLICY_LEARNERS: any number will do if all robots share the policy. */
void policy_action(unsigned learner, const float observation[POLICY_OBSERVATIONS],
                   {{ "PolicyMemory *memory, " if memory else "" }}float action[POLICY_ACTIONS]);

/* Draws an action from the policy around the most likely one, as in evaluation. `normal` are
 * standard normal numbers, independent of each other and of earlier ones. Random actions free
 * robots that would block each other with their most likely actions. */
void policy_sample(unsigned learner, const float normal[POLICY_ACTIONS],
                   float action[POLICY_ACTIONS]);

/* Scales an action, clipped to -1..1 first, to forward speed (m/s) and turn rate (rad/s, left
 * positive). */
void policy_command(const float action[POLICY_ACTIONS], float command[POLICY_ACTIONS]);

/* Turns a command into the speeds of the left and the right wheel (rad/s), each within its limit:
 * wheel radius {{ meta.robot.wheel_radius | short }} m, track {{ meta.robot.track | short }} m, limit {{ meta.robot.max_wheel_speed | short }} rad/s. */
void policy_wheel_speeds(const float command[POLICY_ACTIONS], float wheels[2]);

#endif
