#include "update.h"

#include "step.h"

namespace splat {

void GaussianUpdate::operator()(int64_t first, int64_t count,
                                const GaussianGradients& gradients) const {
    const int64_t three = 3 * first;
    const FrameMoments& f = frame_moments;
    // Frames are those of the scales before the step.
    frame_adam(means + three, quats + 4 * first, log_scales + three, gradients.means,
               gradients.quats,
               {f.mean + three, f.mean_sq + three, f.rotation + three, f.rotation_sq + three},
               count, frames, 1);
    adam_step(log_scales + three, gradients.log_scales, scale_moments.exp_avg + three,
              scale_moments.exp_avg_sq + three, 3 * count, scales, 1);
    adam_step(opacity_logits + first, gradients.opacity_logits, opacity_moments.exp_avg + first,
              opacity_moments.exp_avg_sq + first, count, opacities, 1);
    if (gradient_sum)
        observe_gradients(gradients.means2d, radii + first, scale_x, scale_y, count, 1,
                          gradient_sum + first, seen + first);
}

}  // namespace splat
