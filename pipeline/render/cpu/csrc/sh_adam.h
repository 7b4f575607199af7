// Adam for SH coefficients inside the backward pass, while their gradients are in registers, and
// only for Gaussians with a gradient: SH are four fifths of the parameters, and most Gaussians are
// outside a view or occluded. The effect of skipped steps (decay of the moments and the resulting
// change of the parameter) is applied at the next update.
#pragma once

#include <cmath>

#include "sh.h"
#include "simd_math.h"

namespace splat {

struct ShAdamSettings {
    double rate0, rate;  // learning rates of the constant coefficient and of the others
    double beta1, beta2, eps;
    int64_t step;  // from 1
};

// Moments of sh (N, K, 3) and the step of each Gaussian's last update (N), 0 before the first.
struct ShAdamState {
    float *sh, *exp_avg, *exp_avg_sq;
    int32_t* last;
};

class ShAdam {
  public:
    ShAdam(const ShAdamState& state, const ShAdamSettings& s) : state_(state), step_(s.step) {
        const double to_rate = 1 / (1 - std::pow(s.beta1, double(s.step)));
        for (int i = 0; i < 48; i++) rates_[i] = float((i < 3 ? s.rate0 : s.rate) * to_rate);
        scale_ = float(1 / std::sqrt(1 - std::pow(s.beta2, double(s.step))));
        eps_ = float(s.eps);
        beta1_ = float(s.beta1), rest1_ = float(1 - s.beta1);
        beta2_ = float(s.beta2), rest2_ = float(1 - s.beta2);
        // A step with zero gradient changes the parameter by m / sqrt(v), which decays by this.
        ratio_ = float(s.beta1 / std::sqrt(s.beta2));
        for (int missed = 0; missed < kTable; missed++) table_[missed] = after(missed);
    }

    // gradient: of the group that starts at Gaussian `first`, after ShBlock::to_rows.
    SPLAT_INLINE void update(int degree, const ShBlock& gradient, int64_t first, int64_t width,
                             uint32_t lanes) const {
        const int active = 3 * sh_count(degree);
        for (; lanes; lanes &= lanes - 1) {
            const int lane = __builtin_ctz(lanes);
            const int64_t row = width * (first + lane);
            int32_t& last = state_.last[first + lane];
            const int64_t missed = last < step_ ? step_ - 1 - last : 0;
            last = int32_t(step_);
            const Past past = missed < kTable ? table_[missed] : after(missed);
            for (int j = 0; 16 * j < active; j++) {
                const int here = active - 16 * j < 16 ? active - 16 * j : 16;
                const int64_t at = row + 16 * j;
                f32x16 p = load_first(state_.sh + at, here);
                f32x16 m = load_first(state_.exp_avg + at, here);
                f32x16 v = load_first(state_.exp_avg_sq + at, here);
                const f32x16 g = gradient.value[16 * j + lane],
                             rate = load<f32x16>(rates_ + 16 * j);
                if (missed) p -= rate * past.drift * m * inverse_root(v);
                m = m * past.keep1 + g * rest1_;
                v = v * past.keep2 + g * g * rest2_;
                p -= rate * m * inverse_root(v);
                store_first(state_.sh + at, p, here);
                store_first(state_.exp_avg + at, m, here);
                store_first(state_.exp_avg_sq + at, v, here);
            }
        }
    }

  private:
    // Factors of the moments after a number of steps with zero gradient and the decay of the next
    // one; and the change of the parameter, in units of the last step's change.
    struct Past {
        float keep1, keep2, drift;
    };
    static constexpr int kTable = 256;

    Past after(int64_t missed) const {
        const float n = float(missed);
        return {std::pow(beta1_, n + 1), std::pow(beta2_, n + 1),
                ratio_ * (1 - std::pow(ratio_, n)) / (1 - ratio_)};
    }

    // An infinite moment (of a gradient above 1e19) gives no change, as a division would.
    SPLAT_INLINE f32x16 inverse_root(f32x16 v) const {
        return reciprocal(min(sqrt(v) * scale_ + eps_, splat16(1e37f)));
    }

    ShAdamState state_;
    int64_t step_;
    float rates_[48], scale_, eps_, beta1_, rest1_, beta2_, rest2_;
    float ratio_;
    Past table_[kTable];
};

}  // namespace splat
