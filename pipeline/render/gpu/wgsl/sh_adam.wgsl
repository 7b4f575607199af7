// Adam for the SH coefficients of a Gaussian with a gradient (ShAdam in types.py). The kernel declares
// `view`, `adam`, `sh`, its moments `exp_avg` and `exp_avg_sq`, and `last_step`. First moments are
// bfloat16, two in a word, in rows of whole words; the channels of a coefficient share its second.
#import common
#import adam_rates
#import gradient

// The effect of the steps without a gradient before this one.
struct Missed {
    keep1: f32,  // factors of the moments
    keep2: f32,
    drift: f32,  // change of the parameter, in units of the last step's
}
fn missed_steps(last: i32) -> Missed {
    let missed = f32(max(i32(adam.step) - 1 - last, 0));
    if (missed == 0.0) { return Missed(1.0, 1.0, 0.0); }
    return Missed(pow(adam.beta1, missed), pow(adam.beta2, missed),
                  adam.ratio * (1.0 - pow(adam.ratio, missed)) / (1.0 - adam.ratio));
}

// bfloat16, the upper half of a float32; rounds to nearest, ties to even.
fn low_half(word: u32) -> f32 { return bitcast<f32>(word << 16u); }
fn high_half(word: u32) -> f32 { return bitcast<f32>(word & 0xffff0000u); }
fn half_of(x: f32) -> u32 {
    let bits = bitcast<u32>(x);
    return (bits + 0x7fffu + ((bits >> 16u) & 1u)) >> 16u;
}
fn halves_of(low: f32, high: f32) -> u32 { return half_of(low) | (half_of(high) << 16u); }

fn inverse_root(v: f32) -> f32 { return 1.0 / (sqrt(v) * adam.to_root + adam.epsilon); }

// One step of coefficient `number`; returns its first moments.
fn step_sh(number: u32, moments: vec3<f32>, gradient: vec3<f32>, rate: f32,
           missed: Missed) -> vec3<f32> {
    let before = exp_avg_sq[number];
    let v = before * (missed.keep2 * adam.beta2) + dot(gradient, gradient) * (adam.rest2 / 3.0);
    exp_avg_sq[number] = v;
    let m = moments * (missed.keep1 * adam.beta1) + gradient * adam.rest1;
    var change = m * inverse_root(v);
    if (missed.drift != 0.0) { change += missed.drift * moments * inverse_root(before); }
    let at = 3u * number;
    sh[at] -= rate * change.x;
    sh[at + 1u] -= rate * change.y;
    sh[at + 2u] -= rate * change.z;
    return m;
}

// The learning rates, with the bias correction, are those of the constant coefficient and of others.
fn update_sh(i: u32, g: Gradient, rates: vec2<f32>) {
    let basis = sh_basis(g.direction);
    let row = view.sh_coefficients * i;
    let words = (3u * view.sh_coefficients + 1u) / 2u * i;
    let used = sh_count(view.sh_degree);
    let missed = missed_steps(last_step[i]);
    // Two coefficients are three words.
    for (var k = 0u; k < kBands; k += 2u) {
        if (k >= used) { continue; }
        let word = words + 3u * k / 2u;
        let second = exp_avg[word + 1u];
        let rate = select(rates.y, rates.x, k == 0u);
        var m = vec3(low_half(exp_avg[word]), high_half(exp_avg[word]), low_half(second));
        m = step_sh(row + k, m, basis[k] * g.rgb, rate, missed);
        exp_avg[word] = halves_of(m.x, m.y);
        if (k + 1u >= used) {
            exp_avg[word + 1u] = half_of(m.z) | (second & 0xffff0000u);
            continue;
        }
        let third = exp_avg[word + 2u];
        var next = vec3(high_half(second), low_half(third), high_half(third));
        next = step_sh(row + k + 1u, next, basis[k + 1u] * g.rgb, rates.y, missed);
        exp_avg[word + 1u] = halves_of(m.z, next.x);
        exp_avg[word + 2u] = halves_of(next.y, next.z);
    }
    last_step[i] = i32(adam.step);
}
