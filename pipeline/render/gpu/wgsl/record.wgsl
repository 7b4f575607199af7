// A projected Gaussian. With d the vector from its centre in pixels,
//
//     log2(alpha) = log2_opacity - u^2 - w^2,  u = uu d_x + uw d_y,  w = ww d_y.
//
// [uu 0; uw ww] is the Cholesky factor of log2(e)/2 times the inverse covariance. u and w are at
// most 2.83 inside the ellipse, so that thin, long Gaussians do not suffer the cancellation of
// a dx^2 + 2 b dx dy + c dy^2.
struct Record {
    centre: vec2<f32>,
    uu: f32,
    uw: f32,
    ww: f32,
    log2_opacity: f32,
    depth: f32,
    first_tile: u32,  // of its bounding box, see `box_of` in tile.wgsl
    rgb: vec3<f32>,
    last_tile: u32,
}

// u and w at a pixel.
fn standardised(r: Record, pixel: vec2<f32>) -> vec2<f32> {
    let d = pixel - r.centre;
    return vec2(r.uu * d.x + r.uw * d.y, r.ww * d.y);
}
// Unclamped.
fn alpha_at(r: Record, uw: vec2<f32>) -> f32 {
    return exp2(r.log2_opacity - dot(uw, uw));
}
