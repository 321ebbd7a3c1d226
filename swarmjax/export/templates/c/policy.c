/* See policy.h. From the mathematical library this file needs only tanhf{% if not memory %}, and nothing if the activation is relu{% endif %}. */
#include "policy.h"

#include <math.h>

#define WIDEST {{ widest }}

static const float OFFSET[POLICY_OBSERVATIONS] = {
{{ meta.observation.offset | floats }}
};
static const float SCALE[POLICY_OBSERVATIONS] = {
{{ meta.observation.scale | floats }}
};

/* For each learner: mean and deviation of the observation, the layers, and the deviation of the
 * action. A kernel has a row of inputs for each output. */
{% for name, rows in arrays.items() %}
static const float {{ name }}[POLICY_LEARNERS][{{ rows.shape[1] }}] = {
{% for row in rows %}
{
{{ row | floats }}
},
{% endfor %}
};
{% endfor %}

static float clip(float x, float limit)
{
    return x < -limit ? -limit : x > limit ? limit : x;
}

static void layer(const float *kernel, const float *bias, unsigned inputs, unsigned outputs,
                  const float *x, float *y)
{
    for (unsigned j = 0; j < outputs; j++) {
        float sum = bias[j];
        for (unsigned i = 0; i < inputs; i++) {
            sum += x[i] * *kernel++;
        }
        y[j] = sum;
    }
}

static void activate(float *x, unsigned size)
{
    for (unsigned i = 0; i < size; i++) {
        x[i] = {{ activation }};
    }
}

void policy_observe(const float quantity[POLICY_OBSERVATIONS],
                    float observation[POLICY_OBSERVATIONS])
{
    for (unsigned i = 0; i < POLICY_OBSERVATIONS; i++) {
        observation[i] = (quantity[i] - OFFSET[i]) / SCALE[i];
    }
}

{% if memory %}
static float logistic(float x)
{
    return 0.5f + 0.5f * tanhf(0.5f * x);
}

static void remember(unsigned learner, const float *features, float *recalled)
{
    float seen[3 * POLICY_MEMORY], old[3 * POLICY_MEMORY];
    layer(SEEN_KERNEL[learner], SEEN_BIAS[learner], {{ sizes[-1][0] }}, 3 * POLICY_MEMORY, features, seen);
    layer(RECALLED_KERNEL[learner], RECALLED_BIAS[learner], POLICY_MEMORY, 3 * POLICY_MEMORY,
          recalled, old);
    for (unsigned i = 0; i < POLICY_MEMORY; i++) {
        const unsigned update = POLICY_MEMORY + i, candidate = 2 * POLICY_MEMORY + i;
        const float fresh = tanhf(seen[candidate] + logistic(seen[i] + old[i]) * old[candidate]);
        recalled[i] = fresh + logistic(seen[update] + old[update]) * (recalled[i] - fresh);
    }
}

void policy_begin(PolicyMemory *memory)
{
    for (unsigned i = 0; i < POLICY_MEMORY; i++) {
        memory->recalled[i] = 0.0f;
    }
}

{% endif %}
void policy_action(unsigned learner, const float observation[POLICY_OBSERVATIONS],
                   {{ "PolicyMemory *memory, " if memory else "" }}float action[POLICY_ACTIONS])
{
    float a[WIDEST], b[WIDEST];
    learner %= POLICY_LEARNERS;
    for (unsigned i = 0; i < POLICY_OBSERVATIONS; i++) {
        a[i] = clip((observation[i] - MEAN[learner][i]) / STD[learner][i], {{ meta.observation.limit | float32 }});
    }
{% for inputs, outputs in sizes %}
{% set i = loop.index0 %}
{% set source, target = ("b", "a") if i % 2 else ("a", "b") %}
{% if loop.last and memory %}
    remember(learner, {{ source }}, memory->recalled);
    for (unsigned i = 0; i < POLICY_MEMORY; i++) {
        {{ source }}[{{ inputs }} + i] = memory->recalled[i];
    }
{% endif %}
    layer(KERNEL_{{ i }}[learner], BIAS_{{ i }}[learner], {{ inputs + memory * loop.last }}, {{ outputs }}, {{ source }}, {{ "action" if loop.last else target }});
{% if not loop.last %}
    activate({{ target }}, {{ outputs }});
{% endif %}
{% endfor %}
}

void policy_sample(unsigned learner, const float normal[POLICY_ACTIONS],
                   float action[POLICY_ACTIONS])
{
    learner %= POLICY_LEARNERS;
    for (unsigned i = 0; i < POLICY_ACTIONS; i++) {
        action[i] += DEVIATION[learner][i] * normal[i];
    }
}

void policy_command(const float action[POLICY_ACTIONS], float command[POLICY_ACTIONS])
{
    command[0] = (clip(action[0], 1.0f) + 1.0f) * (0.5f * {{ policy.max_speed | float32 }});
    command[1] = clip(action[1], 1.0f) * {{ policy.max_turn_rate | float32 }};
}

void policy_wheel_speeds(const float command[POLICY_ACTIONS], float wheels[2])
{
    const float turn = command[1] * (0.5f * {{ meta.robot.track | float32 }});
    wheels[0] = clip((command[0] - turn) / {{ meta.robot.wheel_radius | float32 }}, {{ meta.robot.max_wheel_speed | float32 }});
    wheels[1] = clip((command[0] + turn) / {{ meta.robot.wheel_radius | float32 }}, {{ meta.robot.max_wheel_speed | float32 }});
}
