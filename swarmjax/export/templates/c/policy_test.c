/* Compares policy.c with the results of NumPy. Returns 0 if all actions agree, else 1 + the number
 * of the first one that does not. It has no input or output, so it also runs on the robot. */
#include "policy.h"

#define CASES {{ cases.ACTION | length }}
#define TOLERANCE 1e-5f /* times 1 or the action, whichever is larger */

{% for name, rows in cases.items() %}
static const float {{ name }}[CASES][{{ "POLICY_OBSERVATIONS" if name == "OBSERVATION" else "POLICY_ACTIONS" }}] = {
{% for row in rows %}
{
{{ row | floats }}
},
{% endfor %}
};
{% endfor %}

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
{% if memory %}
    PolicyMemory memory[POLICY_LEARNERS];
{% endif %}
    for (int i = 0; i < CASES; i++) {
        float action[POLICY_ACTIONS];
{% if memory %}
        if (i % (CASES / 2) < POLICY_LEARNERS) {
            policy_begin(&memory[i % POLICY_LEARNERS]);
        }
{% endif %}
        policy_action((unsigned)i % POLICY_LEARNERS, OBSERVATION[i], {% if memory %}&memory[i % POLICY_LEARNERS], {% endif %}action);
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
