// Projects each Gaussian, evaluates its colour, and counts the tiles that it overlaps.
#import common
#import projection
#import record
#import sh
#import tile

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> geometry: array<f32>;
@group(0) @binding(2) var<storage, read> sh: array<f32>;
@group(0) @binding(3) var<storage, read_write> records: array<Record>;
@group(0) @binding(4) var<storage, read_write> radii: array<f32>;
@group(0) @binding(5) var<storage, read_write> tile_counts: array<u32>;
@group(0) @binding(6) var<storage, read_write> depths: array<u32>;  // 0: not visible
@group(0) @binding(7) var<storage, read_write> dropped: atomic<u32>;
#import geometry

// Pixel centres [x, y] of [0, size) in [centre - extent, centre + extent].
fn pixel_range(centre: f32, extent: f32, size: u32) -> vec2<f32> {
    return vec2(max(ceil(centre - extent - 0.5), 0.0),
                min(floor(centre + extent - 0.5), f32(size) - 1.0));
}

// The colour (max(0, 1/2 + sum_k basis_k sh_k)), or w = 0 if a coefficient is out of range.
fn color_of(i: u32, mean: vec3<f32>) -> vec4<f32> {
    let d = mean - view.centre;
    let distance = length(d);
    let basis = sh_basis(select(vec3(0.0), d / distance, distance > 0.0));
    var rgb = vec3(0.5);
    var most = 0.0;
    var bounded = true;
    let row = 3u * view.sh_coefficients * i;
    let used = sh_count(view.sh_degree);
    for (var k = 0u; k < kBands; k++) {
        if (k >= used) { continue; }
        let value = vec3(sh[row + 3u * k], sh[row + 3u * k + 1u], sh[row + 3u * k + 2u]);
        bounded &= finite3(value);
        most = max(most, max(abs(value.x), max(abs(value.y), abs(value.z))));
        rgb += basis[k] * value;
    }
    return vec4(max(rgb, vec3(0.0)), select(0.0, 1.0, bounded && most <= kShMax));
}

@compute @workgroup_size(kThreads)
fn main(thread: Thread) {
    let i = number_of(thread);
    if (i >= view.gaussians) { return; }
    radii[i] = 0.0;
    tile_counts[i] = 0u;
    depths[i] = 0u;
    let in = inputs_of(i, view.gaussians);
    if (!valid(in)) {
        atomicAdd(&dropped, 1u);
        return;
    }
    if (in_camera(in.mean, view).z <= view.near) { return; }
    let p = project(in, view);
    // Halves of the axes of the ellipse {alpha >= 1/255}: d^T inverse(cov) d <= reach2.
    let log2_opacity = log2(p.opacity);
    let reach = log2_opacity - kLog2AlphaMin;
    let sound = finite(p.det) && p.det > 0.0 && p.xx < kVarianceMax && p.yy < kVarianceMax
        && finite(p.centre.x) && finite(p.centre.y) && finite(p.cam.z);
    if (!sound) {
        atomicAdd(&dropped, 1u);
        return;
    }
    if (!(reach > 0.0) || !is_ellipse(p, view)) { return; }
    let reach2 = reach / kHalfLog2E;
    let extent = sqrt(reach2 * vec2(p.xx, p.yy));
    let columns = pixel_range(p.centre.x, extent.x, view.size.x);
    let rows = pixel_range(p.centre.y, extent.y, view.size.y);
    if (columns.x > columns.y || rows.x > rows.y) { return; }
    let color = color_of(i, in.mean);
    if (color.w == 0.0) {
        atomicAdd(&dropped, 1u);
        return;
    }
    let half_difference = 0.5 * (p.xx - p.yy);
    let longest = 0.5 * (p.xx + p.yy) + sqrt(half_difference * half_difference + p.xy * p.xy);

    var r: Record;
    r.centre = p.centre;
    let factor = factor_of(p);
    r.uu = factor.x;
    r.uw = factor.y;
    r.ww = factor.z;
    r.log2_opacity = log2_opacity;
    r.depth = p.cam.z;
    r.rgb = color.xyz;
    // With a tolerance for the rounding of the test of tiles.
    let wide = pixel_range(p.centre.x, extent.x + kBoxSlack, view.size.x);
    let high = pixel_range(p.centre.y, extent.y + kBoxSlack, view.size.y);
    let first = vec2(u32(wide.x), u32(high.x)) / kTile;
    let last = vec2(u32(wide.y), u32(high.y)) / kTile;
    r.first_tile = packed(first);
    r.last_tile = packed(last);
    records[i] = r;
    var count = 0u;
    for (var y = first.y; y <= last.y; y++) {
        for (var x = first.x; x <= last.x; x++) {
            count += u32(overlaps(r, vec2(x, y)));
        }
    }
    radii[i] = sqrt(reach2 * longest);
    tile_counts[i] = count;
    // Positive floats are ordered like their bit patterns.
    depths[i] = max(bitcast<u32>(r.depth), 1u);
}
