// L1, squared error and SSIM (Wang et al. 2004) with an 11 x 11 Gaussian window and zero padding.
// With m_x, m_y, m_2, m_xy the blurred x, y, x^2 + y^2, x y,
//
//     SSIM = (2 m_x m_y + C1)(2 (m_xy - m_x m_y) + C2)
//            / ((m_x^2 + m_y^2 + C1)(m_2 - m_x^2 - m_y^2 + C2)),
//     dL/dx = blur(dL/dm_x) + 2 x blur(dL/dm_2) + y blur(dL/dm_xy),
//
// as the window is symmetric. A workgroup handles 16 x 16 pixels of one channel: it computes the three
// derivatives on these pixels and a border, from the images with a border twice as wide. So the
// derivatives are never written to the device's memory.
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
@group(0) @binding(4) var<storage, read_write> gradient: array<f32>;
@group(0) @binding(5) var<storage, read_write> sums: array<vec4<f32>>;  // of each workgroup

const kRadius = 5u;
const kMiddle = kTile + 2u * kRadius;  // the side of the square of the derivatives
const kSide = kTile + 4u * kRadius;    // of the images
const kArea = kSide * kSide;
const kStrip = kMiddle * kSide;  // an image blurred along x
const kMost = (kMiddle * kMiddle + kThreads - 1u) / kThreads;  // derivatives of a thread
const kC1 = 1e-4;
const kC2 = 9e-4;
// exp(-i^2 / (2 1.5^2)), normalised, from the centre outwards. One by one: an array would be in memory.
const kTap0 = 0.26601171493530273;
const kTap1 = 0.21300552785396576;
const kTap2 = 0.1093606874346733;
const kTap3 = 0.03600076958537102;
const kTap4 = 0.0075987582094967365;
const kTap5 = 0.001028380123898387;

// x and y with their border; then x^2 + y^2 and x y; then the derivatives.
var<workgroup> planes: array<f32, 2u * kArea>;
// The planes blurred along x; then the sums of the threads.
var<workgroup> across: array<f32, 2u * kStrip>;

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

fn blurred_across(i: u32) -> f32 {
    return kTap0 * planes[i] + kTap1 * (planes[i - 1u] + planes[i + 1u])
        + kTap2 * (planes[i - 2u] + planes[i + 2u])
        + kTap3 * (planes[i - 3u] + planes[i + 3u])
        + kTap4 * (planes[i - 4u] + planes[i + 4u])
        + kTap5 * (planes[i - 5u] + planes[i + 5u]);
}
fn blurred_down(i: u32, row: u32) -> f32 {
    return kTap0 * across[i] + kTap1 * (across[i - row] + across[i + row])
        + kTap2 * (across[i - 2u * row] + across[i + 2u * row])
        + kTap3 * (across[i - 3u * row] + across[i + 3u * row])
        + kTap4 * (across[i - 4u * row] + across[i + 4u * row])
        + kTap5 * (across[i - 5u * row] + across[i + 5u * row]);
}
// Blurs two planes of kSide x kSide along x.
fn blur_images(local: u32) {
    for (var k = local; k < 2u * kStrip; k += kThreads) {
        let place = k % kStrip;
        let at = (place / kMiddle) * kSide + place % kMiddle + kRadius;
        across[k] = blurred_across((k / kStrip) * kArea + at);
    }
}
// And along y, at a place of the square of the derivatives.
fn blurred_images(place: u32) -> vec2<f32> {
    let at = place + kRadius * kMiddle;
    return vec2(blurred_down(at, kMiddle), blurred_down(kStrip + at, kMiddle));
}

struct Ssim {
    value: f32,
    derivatives: vec3<f32>,  // with respect to m_x, m_2, m_xy
}
fn ssim_of(m: vec2<f32>, products: vec2<f32>) -> Ssim {
    let squares = m.x * m.x + m.y * m.y;
    let product = m.x * m.y;
    let a1 = 2.0 * product + kC1;
    let a2 = 2.0 * (products.y - product) + kC2;
    let b1 = squares + kC1;
    // Rounding may make variances negative.
    let b2 = max(products.x - squares, 0.0) + kC2;
    let inverse = 1.0 / (b1 * b2);
    let value = a1 * a2 * inverse;
    let over_b1 = value * b2 * inverse;
    let over_b2 = value * b1 * inverse;
    let by_mean = 2.0 * (m.y * (a2 - a1) * inverse + m.x * (over_b2 - over_b1));
    return Ssim(value, vec3(by_mean, -over_b2, 2.0 * a1 * inverse));
}

struct Place {
    inside: bool,
    pixel: u32,
}
// The pixel at `k` of a square of `side` around the tile.
fn place_of(tile: vec3<u32>, k: u32, side: u32) -> Place {
    let border = i32(side - kTile) / 2;
    let x = i32(tile.x * kTile + k % side) - border;
    let y = i32(tile.y * kTile + k / side) - border;
    let inside = x >= 0 && y >= 0 && x < i32(loss.size.x) && y < i32(loss.size.y);
    return Place(inside, u32(y) * loss.size.x + u32(x));
}
fn is_of_tile(k: u32) -> bool {
    let x = k % kMiddle;
    let y = k / kMiddle;
    return min(x, y) >= kRadius && max(x, y) < kRadius + kTile;
}

fn load_images(tile: vec3<u32>, local: u32) {
    for (var k = local; k < kArea; k += kThreads) {
        let place = place_of(tile, k, kSide);
        var x = 0.0;
        var y = 0.0;
        if (place.inside) {
            let at = 3u * place.pixel + tile.z;
            x = rendered_at(at, place.pixel, tile.z);
            y = target_at(at);
        }
        planes[k] = x;
        planes[kArea + k] = y;
    }
}
// From x, y to x^2 + y^2, x y.
fn multiply_images(local: u32) {
    for (var k = local; k < kArea; k += kThreads) {
        let both = vec2(planes[k], planes[kArea + k]);
        planes[k] = both.x * both.x + both.y * both.y;
        planes[kArea + k] = both.x * both.y;
    }
}

@compute @workgroup_size(kTile, kTile)
fn main(@builtin(workgroup_id) tile: vec3<u32>, @builtin(num_workgroups) tiles: vec3<u32>,
        @builtin(local_invocation_id) inside: vec3<u32>,
        @builtin(local_invocation_index) local: u32) {
    load_images(tile, local);
    workgroupBarrier();
    let own = (inside.y + 2u * kRadius) * kSide + inside.x + 2u * kRadius;
    let x = planes[own];
    let y = planes[kArea + own];
    blur_images(local);
    workgroupBarrier();
    var means: array<vec2<f32>, kMost>;
    for (var j = 0u; j < kMost; j++) {
        let k = local + j * kThreads;
        if (k < kMiddle * kMiddle) { means[j] = blurred_images(k); }
    }
    multiply_images(local);
    workgroupBarrier();
    blur_images(local);
    workgroupBarrier();
    var value = 0.0;  // SSIM of the tile's pixels of this thread
    for (var j = 0u; j < kMost; j++) {
        let k = local + j * kThreads;
        if (k >= kMiddle * kMiddle) { break; }
        let place = place_of(tile, k, kMiddle);
        var d = vec3(0.0);
        if (place.inside && !is_masked(place.pixel)) {
            let found = ssim_of(means[j], blurred_images(k));
            d = found.derivatives;
            if (is_of_tile(k)) { value += found.value; }
        }
        for (var plane = 0u; plane < 3u; plane++) {
            planes[plane * kMiddle * kMiddle + k] = d[plane];
        }
    }
    workgroupBarrier();
    for (var k = local; k < 3u * kMiddle * kTile; k += kThreads) {
        across[k] = blurred_across((k / kTile) * kMiddle + k % kTile + kRadius);
    }
    workgroupBarrier();
    var blurred = vec3(0.0);
    for (var plane = 0u; plane < 3u; plane++) {
        let row = plane * kMiddle + inside.y + kRadius;
        blurred[plane] = blurred_down(row * kTile + inside.x, kTile);
    }
    let position = tile.xy * kTile + inside.xy;
    let d = x - y;
    var sum = vec3(0.0, value, 0.0);  // error, SSIM, squared difference
    if (all(position < loss.size)) {
        let pixel = position.y * loss.size.x + position.x;
        var result = 0.0;
        if (!is_masked(pixel)) {
            sum = vec3(abs(d) + loss.l2_weight * d * d, value, d * d);
            let ssim = blurred.x + 2.0 * x * blurred.y + y * blurred.z;
            let error = sign(d) + 2.0 * loss.l2_weight * d;
            result = loss.gain[tile.z] * (loss.error_scale * error + loss.ssim_scale * ssim);
        }
        gradient[3u * pixel + tile.z] = result;
    }
    workgroupBarrier();
    add_sums(local, sum);
    if (local == 0u) {
        let total = vec4(across[0], across[kThreads], across[2u * kThreads], 0.0);
        sums[(tile.z * tiles.y + tile.y) * tiles.x + tile.x] = total;
    }
}

// Adds the sums of the threads; those of thread 0 are the totals.
fn add_sums(local: u32, sum: vec3<f32>) {
    for (var n = 0u; n < 3u; n++) { across[n * kThreads + local] = sum[n]; }
    for (var half = kThreads / 2u; half > 0u; half /= 2u) {
        workgroupBarrier();
        if (local < half) {
            for (var n = 0u; n < 3u; n++) {
                across[n * kThreads + local] += across[n * kThreads + local + half];
            }
        }
    }
}
