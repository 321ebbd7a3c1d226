/* See policy.h. From the mathematical library this file needs only tanhf$tanh. */
#include "policy.h"

#include <math.h>

#define WIDEST $widest

static const float OFFSET[POLICY_OBSERVATIONS] = {
$offset
};
static const float SCALE[POLICY_OBSERVATIONS] = {
$scale
};

/* For each learner: mean and deviation of the observation, the layers, and the deviation of the
 * action. A kernel has a row of inputs for each output. */
$arrays

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
        x[i] = $activation;
    }
}

void policy_observe(const float quantity[POLICY_OBSERVATIONS],
                    float observation[POLICY_OBSERVATIONS])
{
    for (unsigned i = 0; i < POLICY_OBSERVATIONS; i++) {
        observation[i] = (quantity[i] - OFFSET[i]) / SCALE[i];
    }
}

${memory_code}void policy_action(unsigned learner, const float observation[POLICY_OBSERVATIONS],
                   ${memory_parameter}float action[POLICY_ACTIONS])
{
    float a[WIDEST], b[WIDEST];
    learner %= POLICY_LEARNERS;
    for (unsigned i = 0; i < POLICY_OBSERVATIONS; i++) {
        a[i] = clip((observation[i] - MEAN[learner][i]) / STD[learner][i], $limit);
    }
$layers
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
    command[0] = (clip(action[0], 1.0f) + 1.0f) * (0.5f * $max_speed);
    command[1] = clip(action[1], 1.0f) * $max_turn_rate;
}

void policy_wheel_speeds(const float command[POLICY_ACTIONS], float wheels[2])
{
    const float turn = command[1] * (0.5f * $track);
    wheels[0] = clip((command[0] - turn) / $wheel_radius, $max_wheel_speed);
    wheels[1] = clip((command[0] + turn) / $wheel_radius, $max_wheel_speed);
}
