#include "project.h"

#include <algorithm>
#include <atomic>
#include <cmath>

#include "group.h"
#include "threads.h"

namespace splat {
namespace {

constexpr double kHalfLog2e = 0.72134752044448170368;  // log2(e) / 2

// Tolerance of the bounding boxes for binning, in pixels: binning computes in float32.
constexpr double kBoxSlack = 0.01;

// Pixel centres [first, last] of [0, size) in [center - extent, center + extent].
struct PixelRange {
    Lanes first, last;
};
SPLAT_INLINE PixelRange pixel_range(Lanes center, Lanes extent, int64_t size) {
    const Lanes first = ceil(center - extent - 0.5), last = floor(center + extent - 0.5);
    const Lanes end = all_lanes(double(size - 1));
    return {select(first > 0.0, first, all_lanes(0.0)), select(last < end, last, end)};
}

// Extent of a Gaussian of full opacity in standard deviations, rounded up.
constexpr double kMostReach = 3.34;

// 0 if every input is finite. float32 values cannot overflow a float64 sum: it is finite if they
// are.
SPLAT_INLINE Lanes finite_sum(const Inputs& in, Lanes norm2) {
    const Lanes sum = (in.mean.x + in.mean.y + in.mean.z) +
                      (in.log_scale.x + in.log_scale.y + in.log_scale.z) +
                      (norm2 + in.opacity_logit);
    return sum - sum;
}

// Culls groups that are outside the view, at a fraction of the cost of the projection. Gaussians
// are sorted in space, so that most groups of a trained scene are culled.
class OutOfView {
  public:
    explicit OutOfView(const View& view) : view_(view) {
        // The Jacobian's rows have the length f / z |(1, u)|, u clamped.
        const auto length = [](double focal, double lowest, double highest) {
            const double u = std::max(std::abs(lowest), std::abs(highest));
            return kMostReach * focal * std::hypot(1.0, u);
        };
        reach_x_ = length(view.fx, view.min_u, view.max_u);
        reach_y_ = length(view.fy, view.min_v, view.max_v);
    }
    // Whether none of a part's Gaussians can be visible or dropped, according to conservative
    // bounds on their ellipses.
    SPLAT_INLINE bool sure(const Inputs& in) const {
        const Vec3 cam = in_camera(in.mean, view_);
        const Lanes inv_z = reciprocal(cam.z);
        const Lanes x = view_.fx * cam.x * inv_z + view_.cx;
        const Lanes y = view_.fy * cam.y * inv_z + view_.cy;
        const auto larger = [](Lanes a, Lanes b) { return select(a > b, a, b); };
        const Lanes longest = larger(in.log_scale.x, larger(in.log_scale.y, in.log_scale.z));
        // sqrt(a^2 + kDilation) < a + 0.55; one pixel of tolerance for rounding.
        const Lanes scale = exp(longest) * inv_z;
        const Lanes reach_x = reach_x_ * scale + (0.55 * kMostReach + 1.0);
        const Lanes reach_y = reach_y_ * scale + (0.55 * kMostReach + 1.0);
        const LaneMask beside = (x + reach_x < 0.0) | (x - reach_x > double(view_.width)) |
                                (y + reach_y < 0.0) | (y - reach_y > double(view_.height));
        // Far from any overflow for which a Gaussian would be dropped.
        const LaneMask tame = (larger(reach_x, reach_y) < 1e12) & (cam.z < 1e12) &
                              (larger(x, -x) < 1e12) & (larger(y, -y) < 1e12);
        const Lanes norm2 = in.quat[0] * in.quat[0] + in.quat[1] * in.quat[1] +
                            in.quat[2] * in.quat[2] + in.quat[3] * in.quat[3];
        const LaneMask usable = (finite_sum(in, norm2) == 0.0) & (norm2 >= kQuatNorm2Min);
        const LaneMask behind = cam.z <= view_.near;
        return bits(usable & (behind | (beside & tame))) == (1u << kProjectLanes) - 1;
    }

  private:
    const View& view_;
    double reach_x_, reach_y_;
};

// A part's projected Gaussians.
struct Seen {
    Lanes x, y, depth, uu, uw, ww, log2_opacity, radius;
    PixelRange columns, rows;  // with tolerance
    uint32_t drawn, dropped;   // one bit per Gaussian
};

SPLAT_INLINE Seen see(const Inputs& in, const View& view) {
    const Projected p = project(in, view);
    Seen s;
    s.x = p.x;
    s.y = p.y;
    s.depth = p.cam.z;
    s.log2_opacity = log2(p.opacity);
    // The Cholesky factor of kHalfLog2e / det [yy -xy; -xy xx]
    const Lanes scaled_yy = kHalfLog2e * p.yy;
    s.uu = scaled_yy * inverse_sqrt(scaled_yy * p.det);
    s.ww = kHalfLog2e * inverse_sqrt(scaled_yy);
    s.uw = -s.uu * p.xy * (s.ww * s.ww * (1 / kHalfLog2e));
    // d^T inverse(cov) d at alpha_min
    const Lanes reach = s.log2_opacity - double(kLog2AlphaMin);
    const Lanes reach2 = clamp(reach, 0.0, 16.0) * (1 / kHalfLog2e);
    const auto root = [](Lanes v) { return v * inverse_sqrt(v); };
    const Lanes half_difference = 0.5 * (p.xx - p.yy);
    const Lanes longest =
        0.5 * (p.xx + p.yy) + sqrt(half_difference * half_difference + p.xy * p.xy);
    s.radius = root(reach2 * longest);
    const Lanes extent_x = root(reach2 * p.xx), extent_y = root(reach2 * p.yy);
    s.columns = pixel_range(p.x, extent_x + kBoxSlack, view.width);
    s.rows = pixel_range(p.y, extent_y + kBoxSlack, view.height);

    const LaneMask usable = (finite_sum(in, p.norm2) == 0.0) & (p.norm2 >= kQuatNorm2Min);
    const LaneMask in_front = p.cam.z > view.near;
    // The centre may be anywhere, but the depth is stored in float32.
    const LaneMask sound = (p.det > 0.0) & (p.xx < kCovarianceMax) & (p.yy < kCovarianceMax) &
                           (p.x - p.x == 0.0) & (p.y - p.y == 0.0) & (p.cam.z < 1e38);
    // The standard deviations along the axes, times the camera's z axis
    const Vec3 forward = row(view.rotation, 2);
    const Vec3 along_z = forward.x * p.m[0] + forward.y * p.m[1] + forward.z * p.m[2];
    const LaneMask ellipse =
        p.cam.z * p.cam.z > (kMinDepthSigmas * kMinDepthSigmas) * dot(along_z, along_z);
    const PixelRange across = pixel_range(p.x, extent_x, view.width);
    const PixelRange down = pixel_range(p.y, extent_y, view.height);
    const uint32_t all = (1u << kProjectLanes) - 1;
    s.dropped = (~bits(usable) | (bits(in_front) & ~bits(sound))) & all;
    s.drawn = bits(usable & in_front & sound & ellipse & (reach > 0.0) &
                   (across.first <= across.last) & (down.first <= down.last));
    return s;
}

// The records of a group, one per vector.
SPLAT_INLINE void make_records(const Seen (&seen)[kGroupParts], const f32x16 (&rgb)[3],
                               f32x16 (&records)[16]) {
    const auto all = [&](Lanes Seen::* field) {
        return narrowed(seen, [=](const Seen& s) { return s.*field; });
    };
    const auto halves = [&](Lanes Seen::* field, f32x16* to) {  // of float64
        alignas(64) float pairs[32];
        for (int i = 0; i < kGroupParts; i++) store(pairs + 2 * kProjectLanes * i, seen[i].*field);
        f32x16 split[2];
        deinterleave(pairs, split);
        to[0] = split[0];
        to[1] = split[1];
    };
    // Two numbers of 16 bits
    const auto corner = [&](Lanes PixelRange::* end) {
        const auto cells = [&](PixelRange Seen::* range) {
            const f32x16 pixel = narrowed(seen, [=](const Seen& s) { return s.*range.*end; });
            return bit_cast<u32x16>(to_int(pixel)) >> kLog2Cell;
        };
        return bit_cast<f32x16>(cells(&Seen::columns) | (cells(&Seen::rows) << 16));
    };
    halves(&Seen::x, records);
    halves(&Seen::y, records + 2);
    records[4] = all(&Seen::uu);
    records[5] = all(&Seen::uw);
    records[6] = all(&Seen::ww);
    records[7] = all(&Seen::log2_opacity);
    for (int c = 0; c < 3; c++) records[8 + c] = rgb[c];
    records[11] = all(&Seen::depth);
    records[12] = corner(&PixelRange::first);
    records[13] = corner(&PixelRange::last);
    records[14] = records[15] = f32x16{};
    transpose(records);
}

}  // namespace

ProjectCounts project_view(const Gaussians& in, const View& view, int threads, Record* records,
                           float* radii) {
    const CameraCenter center(view);
    const OutOfView out_of_view(view);
    const int64_t count = groups(in), sh_width = 3 * in.sh_coefficients;
    std::atomic<int64_t> all_visible{0}, all_dropped{0};
    parallel_ranges(count, 32, threads, [&](int64_t begin, int64_t end) {
        int64_t visible = 0, dropped = 0;
        for (int64_t number = begin; number < end; number++) {
            const Group group(in, number);
            int part = 0;
            while (part < kGroupParts && out_of_view.sure(group.part(part))) part++;
            if (group.count == kGroup && part == kGroupParts) {
                store(radii + group.first, f32x16{});
                continue;
            }
            Seen seen[kGroupParts];
            CameraCenter::Toward toward[kGroupParts];
            uint32_t drawn = 0, unusable = 0;
            for (part = 0; part < kGroupParts; part++) {
                const Inputs inputs = group.part(part);
                seen[part] = see(inputs, view);
                toward[part] = center.toward(inputs.mean);
                drawn |= seen[part].drawn << kProjectLanes * part;
                unusable |= seen[part].dropped << kProjectLanes * part;
            }
            const uint32_t there = (1u << group.count) - 1;
            drawn &= there;
            dropped += __builtin_popcount(there & unusable);
            if (drawn) {
                ShBlock sh;
                sh.read(view.sh_degree, in.sh + sh_width * group.first, sh_width, drawn);
                f32x16 rgb[3], rows[16];
                const uint32_t in_range =
                    sh_colors(directions(toward), view.sh_degree, sh, kShMax, rgb);
                dropped += __builtin_popcount(drawn & ~in_range);
                drawn &= in_range;
                visible += __builtin_popcount(drawn);
                make_records(seen, rgb, rows);
                for (int lane = 0; lane < kGroup; lane++)
                    if (drawn >> lane & 1) store(records + group.first + lane, rows[lane]);
            }
            const f32x16 radius = narrowed(seen, [](const Seen& s) { return s.radius; });
            store_first(radii + group.first, keep(mask(drawn), radius), group.count);
        }
        all_visible += visible;
        all_dropped += dropped;
    });
    return {all_visible, all_dropped};
}

}  // namespace splat
