// The image of a scene of which one part is rendered: composed with 8-bit images of what is in
// front of the part and behind it.
#pragma once

#include <cstdint>

namespace splat {

struct Surroundings {
    int64_t pixels;
    const uint8_t* behind;         // (pixels, 3)
    const uint8_t* alpha;          // (pixels) of the part, before it was changed
    const uint8_t* front;          // (pixels, 3), multiplied by its alpha; may be null
    const uint8_t* transmittance;  // (pixels) of the front; null if it has none
    const int8_t* correction;      // (pixels, 3), added to the composition; may be null
};

// A loss on changes of the part's alpha that exceed the tolerances.
struct AlphaChangeLoss {
    float weight, fade, growth;
};

// Writes image (pixels, 3), the composition with the part's color (pixels, 3) and alpha (pixels).
void compose(const Surroundings& around, const float* color, const float* alpha, int threads,
             float* image);

// Writes the gradients d_color (pixels, 3) and d_alpha (pixels) of a loss with gradient d_image
// (pixels, 3) and of the loss on changes of alpha.
void compose_backward(const Surroundings& around, const float* alpha, const float* d_image,
                      const AlphaChangeLoss& loss, int threads, float* d_color, float* d_alpha);

}  // namespace splat
