// Composites the image from front to back: one workgroup per tile, one thread per pixel.
//
//     C = sum_i T_i alpha_i c_i + T_n background,  T_i = prod_{j < i} (1 - alpha_j)
#import common
#import view
#import record
#import band

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> records: array<Record>;
@group(0) @binding(2) var<storage, read> gaussian_of: array<u32>;  // of each pair
@group(0) @binding(3) var<storage, read> pairs: array<u32>;        // by tile, front to back
@group(0) @binding(4) var<storage, read> ranges: array<vec2<u32>>;
@group(0) @binding(5) var<storage, read_write> color: array<f32>;
// Three images, if any: alpha, depth (sum of weight * z), median depth.
@group(0) @binding(6) var<storage, read_write> planes: array<f32>;
// The number of the tile's pairs up to the last one that contributes to the pixel.
@group(0) @binding(7) var<storage, read_write> ends: array<u32>;
@group(0) @binding(8) var<uniform> band: Band;

var<workgroup> batch: array<Record, kThreads>;
var<workgroup> going: atomic<u32>;  // number of pixels that have not stopped
var<workgroup> any_going: u32;

@compute @workgroup_size(kTile, kTile)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_id) inside: vec3<u32>,
        @builtin(local_invocation_index) local: u32) {
    let tile = group.xy + vec2(0u, band.first_row);
    let position = tile * kTile + inside.xy;
    let pixel = vec2<f32>(position) + 0.5;
    let range = ranges[tile.y * view.tiles.x + tile.x];
    var transmittance = 1.0;
    var rgb = vec3(0.0);
    var depth = 0.0;
    var median = 0.0;
    var end = 0u;
    var stopped = any(position >= view.size);
    for (var begin = range.x; begin < range.y; begin += kThreads) {
        if (local == 0u) { atomicStore(&going, 0u); }
        workgroupBarrier();
        if (!stopped) { atomicAdd(&going, 1u); }
        if (begin + local < range.y) {
            batch[local] = records[gaussian_of[pairs[begin + local]]];
        }
        workgroupBarrier();
        if (local == 0u) { any_going = atomicLoad(&going); }
        if (workgroupUniformLoad(&any_going) == 0u) { break; }
        let count = min(kThreads, range.y - begin);
        for (var k = 0u; k < count && !stopped; k++) {
            let r = batch[k];
            let alpha = min(alpha_at(r, standardised(r, pixel)), kAlphaMax);
            if (alpha < kAlphaMin) { continue; }
            let after = transmittance * (1.0 - alpha);
            if (after < kTransmittanceMin) {
                stopped = true;
                break;
            }
            let weight = transmittance * alpha;
            rgb += weight * r.rgb;
            depth += weight * r.depth;
            if (transmittance >= 0.5 && after < 0.5) { median = r.depth; }
            transmittance = after;
            end = begin + k + 1u - range.x;
        }
        workgroupBarrier();
    }
    if (any(position >= view.size)) { return; }
    let at = position.y * view.size.x + position.x;
    rgb += transmittance * view.background;
    color[3u * at] = rgb.x;
    color[3u * at + 1u] = rgb.y;
    color[3u * at + 2u] = rgb.z;
    ends[at] = end;
    if ((band.flags & kPlanes) != 0u) {
        let pixels = view.size.x * view.size.y;
        planes[at] = 1.0 - transmittance;
        planes[pixels + at] = depth;
        planes[2u * pixels + at] = median;
    }
}
