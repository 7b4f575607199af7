// The images of the loss, as numbers in [0, 1].

struct Loss {
    size: vec2<u32>,
    flags: u32,
    groups: u32,          // workgroups of one channel
    l2_weight: f32,
    error_scale: f32,     // (1 - ssim_weight) / count, where count is of the unmasked values
    ssim_scale: f32,      // -ssim_weight / count
    unused: f32,
    gain: vec3<f32>,      // of the rendered image
    unused2: f32,
}
const kBytes = 1u;   // the target is uint8, four values to a word
const kMasked = 2u;
