// L1, squared error and SSIM (Wang et al. 2004) with an 11 x 11 Gaussian window and zero padding.
// With m_x, m_y, m_2, m_xy the blurred x, y, x^2 + y^2, x y,
//
//     SSIM = (2 m_x m_y + C1)(2 (m_xy - m_x m_y) + C2)
//            / ((m_x^2 + m_y^2 + C1)(m_2 - m_x^2 - m_y^2 + C2)),
//     dL/dx = blur(dL/dm_x) + 2 x blur(dL/dm_2) + y blur(dL/dm_xy),
//
// as the window is symmetric. `forward` writes the three derivatives, `backward` the gradient; a
// workgroup handles 16 x 16 pixels of one channel.
#import common

struct Loss {
    size: vec2<u32>,
    flags: u32,
    unused0: u32,
    l2_weight: f32,
    error_scale: f32,     // (1 - ssim_weight) / count, where count is of the unmasked values
    ssim_scale: f32,      // -ssim_weight / count
    unused: f32,
    gain: vec3<f32>,      // of the rendered image
    unused2: f32,
}
const kBytes = 1u;   // the target is uint8, four values to a word
const kMasked = 2u;

@group(0) @binding(0) var<uniform> loss: Loss;
@group(0) @binding(1) var<storage, read> rendered: array<f32>;
@group(0) @binding(2) var<storage, read> target_words: array<u32>;
@group(0) @binding(3) var<storage, read> mask: array<u32>;
@group(0) @binding(4) var<storage, read_write> derivatives: array<f32>;  // (3, H, W, 3)
@group(0) @binding(5) var<storage, read_write> gradient: array<f32>;
@group(0) @binding(6) var<storage, read_write> sums: array<vec4<f32>>;  // of each workgroup

const kRadius = 5u;
const kSide = kTile + 2u * kRadius;
const kArea = kSide * kSide;
const kC1 = 1e-4;
const kC2 = 9e-4;
// exp(-i^2 / (2 1.5^2)), normalised, from the centre outwards. One by one: an array would be in memory.
const kTap0 = 0.26601171493530273;
const kTap1 = 0.21300552785396576;
const kTap2 = 0.1093606874346733;
const kTap3 = 0.03600076958537102;
const kTap4 = 0.0075987582094967365;
const kTap5 = 0.001028380123898387;

var<workgroup> tile_x: array<f32, kArea>;
var<workgroup> tile_y: array<f32, kArea>;
var<workgroup> tile_z: array<f32, kArea>;
var<workgroup> across: array<vec4<f32>, kTile * kSide>;  // blurred along x
var<workgroup> partial: array<vec4<f32>, kThreads>;

fn byte(word: u32, at: u32) -> u32 {
    return (word >> (8u * (at & 3u))) & 255u;
}
fn is_masked(pixel: u32) -> bool {
    return (loss.flags & kMasked) != 0u && byte(mask[pixel / 4u], pixel) != 0u;
}
fn target_at(at: u32) -> f32 {
    if ((loss.flags & kBytes) != 0u) { return f32(byte(target_words[at / 4u], at)) / 255.0; }
    return bitcast<f32>(target_words[at]);
}
// Masked pixels of the rendered image are replaced by the target's.
fn rendered_at(at: u32, pixel: u32, channel: u32) -> f32 {
    if (is_masked(pixel)) { return target_at(at); }
    return rendered[at] * loss.gain[channel];
}

// x, y, x^2 + y^2, x y
fn products(i: u32) -> vec4<f32> {
    let x = tile_x[i];
    let y = tile_y[i];
    return vec4(x, y, x * x + y * y, x * y);
}
fn blurred_products(i: u32) -> vec4<f32> {
    return kTap0 * products(i) + kTap1 * (products(i - 1u) + products(i + 1u))
        + kTap2 * (products(i - 2u) + products(i + 2u))
        + kTap3 * (products(i - 3u) + products(i + 3u))
        + kTap4 * (products(i - 4u) + products(i + 4u))
        + kTap5 * (products(i - 5u) + products(i + 5u));
}
fn derivatives_at(i: u32) -> vec4<f32> {
    return vec4(tile_x[i], tile_y[i], tile_z[i], 0.0);
}
fn blurred_derivatives(i: u32) -> vec4<f32> {
    return kTap0 * derivatives_at(i) + kTap1 * (derivatives_at(i - 1u) + derivatives_at(i + 1u))
        + kTap2 * (derivatives_at(i - 2u) + derivatives_at(i + 2u))
        + kTap3 * (derivatives_at(i - 3u) + derivatives_at(i + 3u))
        + kTap4 * (derivatives_at(i - 4u) + derivatives_at(i + 4u))
        + kTap5 * (derivatives_at(i - 5u) + derivatives_at(i + 5u));
}
// Along y, of a row of `across`.
fn blurred_down(i: u32) -> vec4<f32> {
    return kTap0 * across[i] + kTap1 * (across[i - kTile] + across[i + kTile])
        + kTap2 * (across[i - 2u * kTile] + across[i + 2u * kTile])
        + kTap3 * (across[i - 3u * kTile] + across[i + 3u * kTile])
        + kTap4 * (across[i - 4u * kTile] + across[i + 4u * kTile])
        + kTap5 * (across[i - 5u * kTile] + across[i + 5u * kTile]);
}

struct Place {
    inside: bool,
    pixel: u32,
}
// A pixel of the tile with its border.
fn place_of(tile: vec3<u32>, k: u32) -> Place {
    let x = i32(tile.x * kTile + k % kSide) - i32(kRadius);
    let y = i32(tile.y * kTile + k / kSide) - i32(kRadius);
    let inside = x >= 0 && y >= 0 && x < i32(loss.size.x) && y < i32(loss.size.y);
    return Place(inside, u32(y) * loss.size.x + u32(x));
}

@compute @workgroup_size(kTile, kTile)
fn forward(@builtin(workgroup_id) tile: vec3<u32>, @builtin(num_workgroups) tiles: vec3<u32>,
           @builtin(local_invocation_id) inside: vec3<u32>,
           @builtin(local_invocation_index) local: u32) {
    for (var k = local; k < kArea; k += kThreads) {
        let place = place_of(tile, k);
        var x = 0.0;
        var y = 0.0;
        if (place.inside) {
            let at = 3u * place.pixel + tile.z;
            x = rendered_at(at, place.pixel, tile.z);
            y = target_at(at);
        }
        tile_x[k] = x;
        tile_y[k] = y;
    }
    workgroupBarrier();
    for (var k = local; k < kTile * kSide; k += kThreads) {
        across[k] = blurred_products((k / kTile) * kSide + k % kTile + kRadius);
    }
    workgroupBarrier();
    let m = blurred_down((inside.y + kRadius) * kTile + inside.x);
    let position = tile.xy * kTile + inside.xy;
    var sum = vec4(0.0);  // error, SSIM, squared difference
    if (all(position < loss.size)) {
        let pixel = position.y * loss.size.x + position.x;
        let at = 3u * pixel + tile.z;
        let weight = select(1.0, 0.0, is_masked(pixel));
        let squares = m.x * m.x + m.y * m.y;
        let product = m.x * m.y;
        let a1 = 2.0 * product + kC1;
        let a2 = 2.0 * (m.w - product) + kC2;
        let b1 = squares + kC1;
        // Rounding may make variances negative.
        let b2 = max(m.z - squares, 0.0) + kC2;
        let inverse = 1.0 / (b1 * b2);
        let value = a1 * a2 * inverse;
        let over_b1 = value * b2 * inverse;
        let over_b2 = value * b1 * inverse;
        let plane = 3u * loss.size.x * loss.size.y;
        derivatives[at] = weight * 2.0 * (m.y * (a2 - a1) * inverse + m.x * (over_b2 - over_b1));
        derivatives[plane + at] = -weight * over_b2;
        derivatives[2u * plane + at] = weight * 2.0 * a1 * inverse;
        let middle = (inside.y + kRadius) * kSide + inside.x + kRadius;
        let d = tile_x[middle] - tile_y[middle];
        sum = weight * vec4(abs(d) + loss.l2_weight * d * d, value, d * d, 0.0);
    }
    partial[local] = sum;
    for (var half = kThreads / 2u; half > 0u; half /= 2u) {
        workgroupBarrier();
        if (local < half) { partial[local] += partial[local + half]; }
    }
    if (local == 0u) {
        sums[(tile.z * tiles.y + tile.y) * tiles.x + tile.x] = partial[0];
    }
}

@compute @workgroup_size(kTile, kTile)
fn backward(@builtin(workgroup_id) tile: vec3<u32>,
            @builtin(local_invocation_id) inside: vec3<u32>,
            @builtin(local_invocation_index) local: u32) {
    let plane = 3u * loss.size.x * loss.size.y;
    for (var k = local; k < kArea; k += kThreads) {
        let place = place_of(tile, k);
        var d = vec3(0.0);
        if (place.inside) {
            let at = 3u * place.pixel + tile.z;
            d = vec3(derivatives[at], derivatives[plane + at], derivatives[2u * plane + at]);
        }
        tile_x[k] = d.x;
        tile_y[k] = d.y;
        tile_z[k] = d.z;
    }
    workgroupBarrier();
    for (var k = local; k < kTile * kSide; k += kThreads) {
        across[k] = blurred_derivatives((k / kTile) * kSide + k % kTile + kRadius);
    }
    workgroupBarrier();
    let position = tile.xy * kTile + inside.xy;
    if (any(position >= loss.size)) { return; }
    let blurred = blurred_down((inside.y + kRadius) * kTile + inside.x);
    let pixel = position.y * loss.size.x + position.x;
    let at = 3u * pixel + tile.z;
    if (is_masked(pixel)) {
        gradient[at] = 0.0;
        return;
    }
    let x = rendered_at(at, pixel, tile.z);
    let y = target_at(at);
    let ssim = blurred.x + 2.0 * x * blurred.y + y * blurred.z;
    let error = sign(x - y) + 2.0 * loss.l2_weight * (x - y);
    gradient[at] = loss.gain[tile.z] * (loss.error_scale * error + loss.ssim_scale * ssim);
}
