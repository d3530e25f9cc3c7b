// How far the light of a pixel may be off.
#pragma once

// Variance of the mean of `count` > 1 samples whose squared distances from it add up to `squares`.  Of few samples
// it is itself uncertain, and taken for larger.
#define NOISE_OF_MEAN(squares, count)                                                              \
    ((squares) / ((count) * ((count) - 1.0f)) * (1.0f + 4.0f / ((count) - 1.0f)))
