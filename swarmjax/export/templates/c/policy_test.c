/* Compares policy.c with the results of NumPy. Returns 0 if all actions agree, else 1 + the number
 * of the first one that does not. It has no input or output, so it also runs on the robot. */
#include "policy.h"

#define CASES $cases
#define TOLERANCE 1e-5f /* times 1 or the action, whichever is larger */

static const float OBSERVATION[CASES][POLICY_OBSERVATIONS] = {
$observation
};
static const float ACTION[CASES][POLICY_ACTIONS] = {
$action
};
static const float NORMAL[CASES][POLICY_ACTIONS] = {
$normal
};
static const float SAMPLE[CASES][POLICY_ACTIONS] = {
$sample
};

static float magnitude(float x)
{
    return x < 0.0f ? -x : x;
}

static int agrees(const float *found, const float *expected)
{
    for (unsigned i = 0; i < POLICY_ACTIONS; i++) {
        const float size = magnitude(expected[i]) > 1.0f ? magnitude(expected[i]) : 1.0f;
        /* Written so that a NaN does not agree. */
        if (!(magnitude(found[i] - expected[i]) <= TOLERANCE * size)) {
            return 0;
        }
    }
    return 1;
}

int main(void)
{
$memory_begin    for (int i = 0; i < CASES; i++) {
        float action[POLICY_ACTIONS];
$memory_reset        policy_action((unsigned)i % POLICY_LEARNERS, OBSERVATION[i], ${memory_argument}action);
        if (!agrees(action, ACTION[i])) {
            return 1 + i;
        }
        policy_sample((unsigned)i % POLICY_LEARNERS, NORMAL[i], action);
        if (!agrees(action, SAMPLE[i])) {
            return 1 + i;
        }
    }
    return 0;
}
