// Adam for SH coefficients inside the backward pass, while their gradients are in registers, and
// only for Gaussians with a gradient: SH are four fifths of the parameters, and most Gaussians are
// outside a view or occluded. The effect of skipped steps (decay of the moments and the resulting
// change of the parameter) is applied at the next update.
//
// The update is limited by memory: first moments are bfloat16, and the channels of a coefficient
// share the second moment of their mean square.
#pragma once

#include <cmath>

#include "bfloat16.h"
#include "sh.h"
#include "simd_math.h"

namespace splat {

struct ShAdamSettings {
    double rate0, rate;  // learning rates of the constant coefficient and of the others
    double beta1, beta2, eps;
    int64_t step;  // from 1
};

// The coefficients (N, K, 3), their first moments in bfloat16, their second moments (N, K), and the
// step of each Gaussian's last update (N), 0 before the first.
struct ShAdamState {
    float* sh;
    uint16_t* exp_avg;
    float* exp_avg_sq;
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

    // gradient: of the group that starts at Gaussian `first`, before ShBlock::to_rows, which this
    // function calls.
    SPLAT_INLINE void update(int degree, ShBlock& gradient, int64_t first, int64_t width,
                             uint32_t lanes) const {
        const int count = sh_count(degree);
        f32x16 squares[16] = {};
        for (int k = 0; k < count; k++) {
            for (int c = 0; c < 3; c++)
                squares[k] += gradient.value[3 * k + c] * gradient.value[3 * k + c];
            squares[k] *= rest2_ / 3;
        }
        transpose(squares);
        gradient.to_rows(degree);
        for (; lanes; lanes &= lanes - 1) {
            const int lane = __builtin_ctz(lanes);
            const int64_t row = width * (first + lane);
            int32_t& last = state_.last[first + lane];
            const int64_t missed = last < step_ ? step_ - 1 - last : 0;
            last = int32_t(step_);
            const Past past = missed < kTable ? table_[missed] : after(missed);
            float* const second = state_.exp_avg_sq + row / 3;
            f32x16 v = load_first(second, count);
            alignas(64) float before[48], now[48];
            if (missed) each_channel(inverse_root(v) * past.drift, before);
            v = v * past.keep2 + squares[lane];
            each_channel(inverse_root(v), now);
            store_first(second, v, count);
            for (int j = 0; 16 * j < 3 * count; j++) {
                const int here = 3 * count - 16 * j < 16 ? 3 * count - 16 * j : 16;
                const int64_t at = row + 16 * j;
                f32x16 p = load_first(state_.sh + at, here);
                f32x16 m = load_bfloat16(state_.exp_avg + at, here);
                const f32x16 g = gradient.value[16 * j + lane],
                             rate = load<f32x16>(rates_ + 16 * j);
                if (missed) p -= rate * m * load<f32x16>(before + 16 * j);
                m = m * past.keep1 + g * rest1_;
                p -= rate * m * load<f32x16>(now + 16 * j);
                store_first(state_.sh + at, p, here);
                store_bfloat16(state_.exp_avg + at, m, here);
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

    // Values of coefficients in the order of a row: three times each.
    SPLAT_INLINE static void each_channel(f32x16 v, float (&row)[48]) {
        const f32x16 channels[3] = {v, v, v};
        interleave(channels, row);
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
