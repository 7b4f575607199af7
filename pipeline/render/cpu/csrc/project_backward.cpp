#include <algorithm>
#include <cmath>
#include <cstring>

#include "group.h"
#include "memory.h"
#include "project.h"
#include "threads.h"
#include "update.h"

namespace splat {
namespace {

constexpr double kLn2 = 0.69314718055994530942;

// Sum of one Gaussian's slots, with the lanes of a slot.
SPLAT_INLINE f32x16 sum_slots(const Slots& slots, const float* slot_gradients) {
    Lanes sum[kGroupParts] = {};
    for (uint32_t s = 0; s < slots.count; s++) {
        const f32x16 slot = load<f32x16>(slot_gradients + int64_t(slots.first + s) * kSlotFloats);
        for (int i = 0; i < kGroupParts; i++) sum[i] += widened(slot, i);
    }
    return narrowed(sum, [](const Lanes& lanes) { return lanes; });
}

// Inputs of a group: fields of the records, and sums of the slots by Moment.
struct GroupMoments {
    f32x16 uu, uw, ww, rgb[3];
    f32x16 moment[kMoments];

    // Zeros in the lanes that are not in `drawn`.
    GroupMoments(const Record* records, const Slots* slots, const float* slot_gradients,
                 uint32_t drawn) {
        f32x16 record[16], sums[16];
        for (int lane = 0; lane < kGroup; lane++) {
            const bool is_drawn = drawn >> lane & 1;
            record[lane] = is_drawn ? load<f32x16>(records + lane) : f32x16{};
            sums[lane] = is_drawn ? sum_slots(slots[lane], slot_gradients) : f32x16{};
        }
        transpose(record);
        transpose(sums);
        uu = record[4];
        uw = record[5];
        ww = record[6];
        for (int c = 0; c < 3; c++) rgb[c] = record[8 + c];
        for (int m = 0; m < kMoments; m++) moment[m] = sums[sum_lane(m)];
    }

    // The lanes with a gradient: occluded Gaussians have none.
    SPLAT_INLINE uint32_t any() const {
        const f32x16 zero = {};
        f32x16 most = zero;
        for (const f32x16& m : moment) most = max(most, abs(m));
        return bits(most > zero);
    }

    // From the moments of y = (u, w) to the image plane. ln alpha = ln opacity - ln 2 (u^2 + w^2)
    // and y = L^T d with L = [uu 0; uw ww], so d(ln alpha) / d(centre) = 2 ln 2 L y.
    SPLAT_INLINE ImageGradients part(int number) const {
        const auto get = [&](Moment m) { return widened(moment[m], number); };
        const Lanes l00 = widened(uu, number), l10 = widened(uw, number), l11 = widened(ww, number);
        ImageGradients g;
        g.x = 2.0 * kLn2 * l00 * get(kVU);
        g.y = 2.0 * kLn2 * (l10 * get(kVU) + l11 * get(kVW));
        // inverse(cov) = 2 ln2 L L^T, d = L^-T y: 1/2 inverse(cov) (sum v d d^T) inverse(cov)
        //   = 2 ln2^2 L (sum v y y^T) L^T
        const double k = 2.0 * kLn2 * kLn2;
        const Lanes a = get(kVUU), b = get(kVUW), c = get(kVWW);
        g.xx = k * l00 * l00 * a;
        g.xy = 2.0 * k * l00 * (l10 * a + l11 * b);
        g.yy = k * (l10 * l10 * a + 2.0 * l10 * l11 * b + l11 * l11 * c);
        g.depth = get(kDepth);
        g.ln_opacity = get(kV);
        return g;
    }
};

// Gradients of a group, except for the SH coefficients.
struct GroupGradients {
    f32x16 mean[3], log_scale[3], quat[4], opacity_logit, means2d[2];

    GroupGradients(const InputGradients (&g)[kGroupParts],
                   const ImageGradients (&image)[kGroupParts]) {
        const auto three = [&](Vec3 InputGradients::* field, f32x16* to) {
            to[0] = narrowed(g, [=](const InputGradients& part) { return (part.*field).x; });
            to[1] = narrowed(g, [=](const InputGradients& part) { return (part.*field).y; });
            to[2] = narrowed(g, [=](const InputGradients& part) { return (part.*field).z; });
        };
        three(&InputGradients::mean, mean);
        three(&InputGradients::log_scale, log_scale);
        for (int k = 0; k < 4; k++)
            quat[k] = narrowed(g, [=](const InputGradients& part) { return part.quat[k]; });
        opacity_logit = narrowed(g, [](const InputGradients& part) { return part.opacity_logit; });
        means2d[0] = narrowed(image, [](const ImageGradients& part) { return part.x; });
        means2d[1] = narrowed(image, [](const ImageGradients& part) { return part.y; });
    }
    template <class Visit>
    SPLAT_INLINE void each(const Visit& visit) {
        for (f32x16& v : mean) visit(v);
        for (f32x16& v : log_scale) visit(v);
        for (f32x16& v : quat) visit(v);
        visit(opacity_logit);
        for (f32x16& v : means2d) visit(v);
    }
};

// Writes zero gradients of `count` Gaussians.
void write_zeros(const GaussianGradients& out, int count, int64_t sh_width) {
    const auto clear = [&](float* to, int64_t width) {
        if (to) std::memset(to, 0, size_t(width) * count * sizeof(float));
    };
    clear(out.means, 3);
    clear(out.log_scales, 3);
    clear(out.quats, 4);
    clear(out.opacity_logits, 1);
    clear(out.means2d, 2);
    clear(out.colors, 3);
    clear(out.sh, sh_width);
}

// A group's contribution to the camera's gradients. d_mean: gradient through the viewing direction,
// which a translation of the scene changes like a translation of the means.
void add_camera(const Group& group, const View& view, const ImageGradients (&image)[kGroupParts],
                const InputGradients (&gradients)[kGroupParts], const f32x16 (&d_mean)[3],
                uint32_t sound, double (&out)[kCameraParameters]) {
    for (int part = 0; part < kGroupParts; part++) {
        Lanes share[kCameraParameters];
        camera_backward(project(group.part(part), view), image[part], gradients[part], view, share);
        const Vec3 turned = {widened(d_mean[0], part), widened(d_mean[1], part),
                             widened(d_mean[2], part)};
        for (int i = 0; i < 3; i++) share[3 + i] += dot(row(view.rotation, i), turned);
        double values[kCameraParameters][kProjectLanes];
        std::memcpy(values, share, sizeof(values));
        for (int lane = 0; lane < kProjectLanes; lane++) {
            if (!(sound >> (kProjectLanes * part + lane) & 1)) continue;
            for (int k = 0; k < kCameraParameters; k++)
                if (std::isfinite(values[k][lane])) out[k] += values[k][lane];
        }
    }
}

// Groups whose gradients are in the cache at once.
constexpr int64_t kBlock = 8, kBlocksPerRange = 4;

// The gradients of a block, if an update consumes them.
struct BlockGradients {
    alignas(64) float means[kBlock * kGroup * 3], log_scales[kBlock * kGroup * 3],
        quats[kBlock * kGroup * 4], opacity_logits[kBlock * kGroup], means2d[kBlock * kGroup * 2];
};

}  // namespace

void project_view_backward(const Gaussians& in, const View& view, int threads,
                           const Record* records, const float* radii, const Slots* slots,
                           const float* slot_gradients, const GaussianGradients& all,
                           double* camera, const ShAdam* sh_adam, const GaussianUpdate* update) {
    const CameraCenter center(view);
    const int64_t count = groups(in), sh_width = 3 * in.sh_coefficients;
    // Sums of each group, all of one parameter after another, added in order: the result does not
    // depend on the number of threads.
    const Scratch<double> of_groups(camera ? kCameraParameters * count : 0);
    const auto backward = [&](int64_t number, const GaussianGradients& out) {
        const Group group(in, number);
        const int64_t first = group.first;
        double of_camera[kCameraParameters] = {};
        const auto write_camera = [&] {
            if (!camera) return;
            for (int k = 0; k < kCameraParameters; k++)
                of_groups[count * k + number] = of_camera[k];
        };
        uint32_t drawn = 0;
        for (int lane = 0; lane < group.count; lane++)
            drawn |= uint32_t(radii[first + lane] > 0 && slots[first + lane].count > 0) << lane;

        if (!drawn) {
            write_zeros(out, group.count, sh_width);
            write_camera();
            return;
        }
        const GroupMoments moments(records + first, slots + first, slot_gradients, drawn);
        drawn &= moments.any();
        if (!drawn) {
            write_zeros(out, group.count, sh_width);
            write_camera();
            return;
        }
        ImageGradients image[kGroupParts];
        InputGradients gradients[kGroupParts];
        CameraCenter::Toward toward[kGroupParts];
        for (int part = 0; part < kGroupParts; part++) {
            const Inputs inputs = group.part(part);
            image[part] = moments.part(part);
            gradients[part] = project_backward(project(inputs, view), image[part], view);
            toward[part] = center.toward(inputs.mean);
        }
        GroupGradients g(gradients, image);

        // A clamped colour receives only gradients that increase it. In 3DGS it receives none
        // (view.clamp_color_gradient): a Gaussian that is black in all views stays black.
        Mask16 sound = mask(drawn);  // every gradient is finite in float32
        const f32x16 zero = {}, most = splat16(1e37f);
        const auto check = [&](f32x16& v) { sound = sound & (most >= abs(v)); };
        f32x16 d_rgb[3], d_mean[3];
        for (int c = 0; c < 3; c++) {
            const f32x16 d = moments.moment[kRed + c];
            const f32x16 rising = view.clamp_color_gradient ? zero : min(d, zero);
            d_rgb[c] = select(moments.rgb[c] > zero, d, rising);
            check(d_rgb[c]);
        }
        ShBlock sh;
        sh.read(view.sh_degree, in.sh + sh_width * first, sh_width, drawn);
        sh_backward(directions(toward), view.sh_degree, d_rgb, sh, d_mean);
        for (int k = 0; k < 3; k++) g.mean[k] += d_mean[k];

        g.each(check);
        const auto clear = [&](f32x16& v) { v = keep(sound, v); };
        g.each(clear);
        for (f32x16& v : d_rgb) clear(v);
        for (int k = 0; k < 3 * sh_count(view.sh_degree); k++) clear(sh.value[k]);

        if (camera) add_camera(group, view, image, gradients, d_mean, bits(sound), of_camera);
        write_camera();
        write_rows(g.mean, group.count, out.means);
        write_rows(g.log_scale, group.count, out.log_scales);
        write_rows(g.quat, group.count, out.quats);
        store_first(out.opacity_logits, g.opacity_logit, group.count);
        write_rows(g.means2d, group.count, out.means2d);
        if (out.colors) write_rows(d_rgb, group.count, out.colors);
        if (sh_adam)
            sh_adam->update(view.sh_degree, sh, first, sh_width, drawn);
        else if (out.sh)
            sh.write(view.sh_degree, out.sh, sh_width, group.count);
    };
    parallel_for((count + kBlock - 1) / kBlock, kBlocksPerRange, threads, [&](int64_t block) {
        const int64_t begin = kBlock * block, end = std::min(begin + kBlock, count);
        const int64_t first = kGroup * begin;
        GaussianGradients out = all.from(first, sh_width);
        BlockGradients of_block;
        if (update) {
            out.means = of_block.means;
            out.log_scales = of_block.log_scales;
            out.quats = of_block.quats;
            out.opacity_logits = of_block.opacity_logits;
            out.means2d = of_block.means2d;
        }
        for (int64_t number = begin; number < end; number++)
            backward(number, out.from(kGroup * (number - begin), sh_width));
        if (update) (*update)(first, std::min(kGroup * kBlock, in.count - first), out);
    });
    parallel_for(camera ? kCameraParameters : 0, 1, threads, [&](int64_t k) {
        double sum = 0;
        for (int64_t number = 0; number < count; number++) sum += of_groups[count * k + number];
        camera[k] = sum;
    });
}

}  // namespace splat
