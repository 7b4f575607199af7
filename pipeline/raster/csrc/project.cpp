#include "project.h"

#include <atomic>

#include "group.h"
#include "threads.h"

namespace splat {
namespace {

constexpr double kHalfLog2e = 0.72134752044448170368;  // log2(e) / 2

// Slack of the boxes in which binning looks for pixels, in pixels: its own arithmetic is float32.
constexpr double kBoxSlack = 0.01;

// Pixel centres [first, last] of [0, size) in [center - extent, center + extent].
struct PixelRange {
    Lanes first, last;
};
SPLAT_INLINE PixelRange pixel_range(Lanes center, Lanes extent, int64_t size) {
    const Lanes first = ceil(center - extent - 0.5), last = floor(center + extent - 0.5);
    const Lanes end = splat8(double(size - 1));
    return {select(first > 0.0, first, splat8(0.0)), select(last < end, last, end)};
}

// Eight Gaussians on the image.
struct Seen {
    Lanes x, y, depth, uu, uw, ww, log2_opacity, radius;
    PixelRange columns, rows;  // with slack
    uint32_t drawn, dropped;   // a bit each
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

    // Every input is finite and the quaternion has a direction. float32 values cannot overflow a
    // float64 sum: it is finite when they are.
    const Lanes sum = (in.mean.x + in.mean.y + in.mean.z) +
                      (in.log_scale.x + in.log_scale.y + in.log_scale.z) +
                      (p.norm2 + in.opacity_logit);
    const i64x8 usable = i64x8(sum - sum == 0.0) & i64x8(p.norm2 >= kQuatNorm2Min);
    const i64x8 in_front = i64x8(p.cam.z > view.near);
    // The centre may lie anywhere, but the depth is kept in float32.
    const i64x8 sound = i64x8(p.det > 0.0) & i64x8(p.xx < kCovarianceMax) &
                        i64x8(p.yy < kCovarianceMax) & i64x8(p.x - p.x == 0.0) &
                        i64x8(p.y - p.y == 0.0) & i64x8(p.cam.z < 1e38);
    const PixelRange across = pixel_range(p.x, extent_x, view.width);
    const PixelRange down = pixel_range(p.y, extent_y, view.height);
    s.dropped = bits(~usable | (in_front & ~sound));
    s.drawn = bits(usable & in_front & sound & i64x8(reach > 0.0) &
                   i64x8(across.first <= across.last) & i64x8(down.first <= down.last));
    return s;
}

// The records of a group, one a vector.
SPLAT_INLINE void make_records(const Seen (&s)[2], const f32x16 (&rgb)[3], f32x16 (&records)[16]) {
    const auto both = [&](Lanes Seen::* field) { return narrow(s[0].*field, s[1].*field); };
    const auto halves = [&](Lanes Seen::* field, f32x16* to) {  // of float64
        alignas(64) float pairs[32];
        store(pairs, s[0].*field);
        store(pairs + 16, s[1].*field);
        f32x16 split[2];
        deinterleave(pairs, split);
        to[0] = split[0];
        to[1] = split[1];
    };
    // Two numbers of 16 bits
    const auto corner = [&](Lanes PixelRange::* end) {
        const auto blocks = [&](PixelRange Seen::* range) {
            const f32x16 pixel = narrow(s[0].*range.*end, s[1].*range.*end);
            return u32x16(__builtin_convertvector(pixel, i32x16)) / uint32_t(kBlock);
        };
        return f32x16(blocks(&Seen::columns) | (blocks(&Seen::rows) << 16));
    };
    halves(&Seen::x, records);
    halves(&Seen::y, records + 2);
    records[4] = both(&Seen::uu);
    records[5] = both(&Seen::uw);
    records[6] = both(&Seen::ww);
    records[7] = both(&Seen::log2_opacity);
    for (int c = 0; c < 3; c++) records[8 + c] = rgb[c];
    records[11] = both(&Seen::depth);
    records[12] = corner(&PixelRange::first);
    records[13] = corner(&PixelRange::last);
    records[14] = records[15] = f32x16{};
    transpose(records);
}

}  // namespace

ProjectCounts project_view(const Gaussians& in, const View& view, int threads, Record* records,
                           float* radii) {
    const CameraCenter center(view);
    const int64_t count = groups(in), sh_width = 3 * in.sh_coefficients;
    std::atomic<int64_t> all_visible{0}, all_dropped{0};
    parallel_ranges(count, 32, threads, [&](int64_t begin, int64_t end) {
        int64_t visible = 0, dropped = 0;
        for (int64_t number = begin; number < end; number++) {
            const Group group(in, number);
            Seen seen[2];
            CameraCenter::Toward toward[2];
            for (int h = 0; h < 2; h++) {
                const Inputs half = group.half(h);
                seen[h] = see(half, view);
                toward[h] = center.toward(half.mean);
            }
            const uint32_t there = (1u << group.count) - 1;
            uint32_t drawn = there & (seen[0].drawn | seen[1].drawn << 8);
            dropped += __builtin_popcount(there & (seen[0].dropped | seen[1].dropped << 8));
            if (drawn) {
                ShBlock sh;
                sh.read(view.sh_degree, in.sh + sh_width * group.first, sh_width, drawn);
                f32x16 rgb[3], rows[16];
                const uint32_t sane =
                    sh_colors(directions(toward), view.sh_degree, sh, kShMax, rgb);
                dropped += __builtin_popcount(drawn & ~sane);
                drawn &= sane;
                visible += __builtin_popcount(drawn);
                make_records(seen, rgb, rows);
                for (int lane = 0; lane < kGroup; lane++)
                    if (drawn >> lane & 1) store(records + group.first + lane, rows[lane]);
            }
            write_column(keep(mask(drawn), narrow(seen[0].radius, seen[1].radius)), group.count,
                         radii + group.first);
        }
        all_visible += visible;
        all_dropped += dropped;
    });
    return {all_visible, all_dropped};
}

}  // namespace splat
