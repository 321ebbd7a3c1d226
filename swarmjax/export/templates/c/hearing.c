static void hear(unsigned learner, float *x)
{
    float sum[$width] = {0.0f}, each[$width];
    for (unsigned k = 0; k < $count; k++) {
        const float *row = x + $first + k * $row;
        layer(HEARING_KERNEL[learner], HEARING_BIAS[learner], $row, $width, row, each);
        activate(each, $width);
        for (unsigned i = 0; i < $width; i++) {
            sum[i] += row[0] * each[i];
        }
    }
    for (unsigned i = 0; i < $width; i++) {
        x[$first + i] = sum[i];
    }
}

