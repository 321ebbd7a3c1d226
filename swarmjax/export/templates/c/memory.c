static float logistic(float x)
{
    return 0.5f + 0.5f * tanhf(0.5f * x);
}

static void remember(unsigned learner, const float *features, float *recalled)
{
    float seen[3 * POLICY_MEMORY], old[3 * POLICY_MEMORY];
    layer(SEEN_KERNEL[learner], SEEN_BIAS[learner], $features, 3 * POLICY_MEMORY, features, seen);
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

