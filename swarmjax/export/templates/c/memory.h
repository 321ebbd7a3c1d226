#define POLICY_MEMORY $size

/* The memory of a robot. */
typedef struct {
    float recalled[POLICY_MEMORY];
} PolicyMemory;

/* Clears the memory, as at the start of an episode. */
void policy_begin(PolicyMemory *memory);

