// Backward of blend, front to back like forward. With e_i = dL/d(color) . rgb_i + dL/d(alpha)
// + dL/d(depth) z_i and S_i = sum_{j > i} w_j e_j, known from the finished pixel,
//
//     dL/d(alpha_i) = T_i e_i - S_i / (1 - alpha_i).
//
// A workgroup handles a tile, kBatch Gaussians at a time: first each thread computes the weights
// and v of its pixel, then 32 threads sum the moments of each Gaussian over the pixels. One slot per
// pair and a fixed order of summation: no atomic additions of floats.
#import common
#import view
#import record
#import band
#import moments

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> records: array<Record>;
@group(0) @binding(2) var<storage, read> gaussian_of: array<u32>;
@group(0) @binding(3) var<storage, read> pairs: array<u32>;
@group(0) @binding(4) var<storage, read> ranges: array<vec2<u32>>;
@group(0) @binding(5) var<storage, read> ends: array<u32>;
@group(0) @binding(6) var<storage, read> color: array<f32>;
@group(0) @binding(7) var<storage, read> planes: array<f32>;
@group(0) @binding(8) var<storage, read> d_color: array<f32>;
@group(0) @binding(9) var<storage, read> d_planes: array<f32>;  // of alpha and depth
@group(0) @binding(10) var<storage, read_write> slots: array<f32>;
@group(0) @binding(11) var<uniform> band: Band;

const kBatch = 8u;
const kPerGaussian = kThreads / kBatch;  // threads that sum one Gaussian's moments
const kSums = kBatch * kMoments;

var<workgroup> batch: array<Record, kBatch>;
// v and weight of kBatch x kThreads pairs; then the partial sums of the moments.
var<workgroup> shared_values: array<f32, 2u * kBatch * kThreads>;
var<workgroup> d_pixel: array<vec4<f32>, kThreads>;  // dL/d(rgb), dL/d(depth)
var<workgroup> last: atomic<u32>;
var<workgroup> tile_end: u32;

@compute @workgroup_size(kTile, kTile)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_id) inside: vec3<u32>,
        @builtin(local_invocation_index) local: u32) {
    let tile = group.xy + vec2(0u, band.first_row);
    let corner = vec2<f32>(tile * kTile) + 0.5;
    let position = tile * kTile + inside.xy;
    let pixel = corner + vec2<f32>(inside.xy);
    let range = ranges[tile.y * view.tiles.x + tile.x];
    var end = 0u;
    var d_rgb = vec3(0.0);
    var d_alpha = 0.0;
    var d_depth = 0.0;
    var behind = 0.0;  // S: starts as the whole sum
    if (all(position < view.size)) {
        let at = position.y * view.size.x + position.x;
        end = ends[at];
        d_rgb = vec3(d_color[3u * at], d_color[3u * at + 1u], d_color[3u * at + 2u]);
        // The weight of the background is 1 - alpha.
        let under = dot(d_rgb, view.background);
        let rgb = vec3(color[3u * at], color[3u * at + 1u], color[3u * at + 2u]);
        d_alpha = -under;
        behind = dot(rgb, d_rgb) - under;
        if ((band.flags & kPlanes) != 0u) {
            let pixels = view.size.x * view.size.y;
            d_depth = d_planes[pixels + at];
            d_alpha = d_planes[at] - under;
            behind += planes[at] * d_planes[at] + planes[pixels + at] * d_depth;
        }
    }
    d_pixel[local] = vec4(d_rgb, d_depth);
    if (local == 0u) { atomicStore(&last, 0u); }
    workgroupBarrier();
    atomicMax(&last, end);
    workgroupBarrier();
    if (local == 0u) { tile_end = atomicLoad(&last); }
    let stop = range.x + workgroupUniformLoad(&tile_end);

    var transmittance = 1.0;
    let mine = local / kPerGaussian;  // the Gaussian whose moments this thread sums
    let part = local % kPerGaussian;
    for (var begin = range.x; begin < stop; begin += kBatch) {
        let count = min(kBatch, stop - begin);
        if (local < count) { batch[local] = records[gaussian_of[pairs[begin + local]]]; }
        workgroupBarrier();
        for (var k = 0u; k < kBatch; k++) {
            var v = 0.0;
            var weight = 0.0;
            if (begin + k < range.x + end) {
                let r = batch[k];
                let alpha = min(alpha_at(r, standardised(r, pixel)), kAlphaMax);
                if (alpha >= kAlphaMin) {
                    weight = transmittance * alpha;
                    let e = dot(d_rgb, r.rgb) + d_alpha + d_depth * r.depth;
                    behind -= weight * e;
                    // A clamped alpha has no gradient.
                    if (alpha < kAlphaMax) { v = weight * e - alpha / (1.0 - alpha) * behind; }
                    transmittance *= 1.0 - alpha;
                }
            }
            shared_values[k * kThreads + local] = v;
            shared_values[(kBatch + k) * kThreads + local] = weight;
        }
        workgroupBarrier();
        var sums = array<f32, kMoments>();
        if (mine < count) {
            let r = batch[mine];
            for (var j = 0u; j < kThreads; j += kPerGaussian) {
                let p = j + part;
                let v = shared_values[mine * kThreads + p];
                let weight = shared_values[(kBatch + mine) * kThreads + p];
                let uw = standardised(r, corner + vec2<f32>(vec2(p % kTile, p / kTile)));
                let vu = v * uw.x;
                let vw = v * uw.y;
                sums[kV] += v;
                sums[kVU] += vu;
                sums[kVW] += vw;
                sums[kVUU] += vu * uw.x;
                sums[kVUW] += vu * uw.y;
                sums[kVWW] += vw * uw.y;
                let d = d_pixel[p];
                sums[kRed] += weight * d.x;
                sums[kGreen] += weight * d.y;
                sums[kBlue] += weight * d.z;
                sums[kDepth] += weight * d.w;
            }
        }
        workgroupBarrier();
        for (var m = 0u; m < kMoments; m++) {
            shared_values[(mine * kMoments + m) * kPerGaussian + part] = sums[m];
        }
        workgroupBarrier();
        if (local < kSums && local / kMoments < count) {
            var sum = 0.0;
            for (var j = 0u; j < kPerGaussian; j++) {
                // Threads start at different banks.
                sum += shared_values[local * kPerGaussian + (j + local) % kPerGaussian];
            }
            slots[pairs[begin + local / kMoments] * kMoments + local % kMoments] = sum;
        }
        workgroupBarrier();
    }
    // The pairs that no pixel draws.
    for (var i = stop * kMoments + local; i < range.y * kMoments; i += kThreads) {
        slots[pairs[i / kMoments] * kMoments + i % kMoments] = 0.0;
    }
}
