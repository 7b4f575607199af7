// Stage 1: world Gaussians to Records on the image, and at the very end the way back.
#pragma once

#include "sh_adam.h"
#include "types.h"

namespace splat {

struct ProjectCounts {
    int64_t visible = 0, dropped = 0;
};

// Fills radii (N) for all, records (N) for those with radius > 0 only. Dropped: a value that is
// not finite, a quaternion without direction, a covariance out of range, insane colour.
ProjectCounts project_view(const Gaussians& in, const View& view, int threads, Record* records,
                           float* radii);

// dL/d(parameter), each shaped as its parameter; means2d and means2d_abs (N, 2), the latter may
// be null, and sh where it is used up at once. camera: kCameraParameters sums over the Gaussians,
// may be null. All are written, zeros where there is nothing.
struct GaussianGradients {
    float *means, *log_scales, *quats, *opacity_logits, *sh, *means2d, *means2d_abs;
    double* camera;
};

// Sums the gradient slots of each Gaussian in their order and takes the sums back to its
// parameters. A Gaussian of which any gradient leaves float32 gets zeros. With sh_adam the
// harmonics of those in view are moved, too.
void project_view_backward(const Gaussians& in, const View& view, int threads,
                           const Record* records, const float* radii, const Slots* slots,
                           const float* slot_gradients, const GaussianGradients& out,
                           const ShAdam* sh_adam);

}  // namespace splat
