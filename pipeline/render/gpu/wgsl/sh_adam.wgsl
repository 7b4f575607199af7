// Adam for the SH coefficients of a Gaussian with a gradient (ShAdam in types.py). The kernel declares
// `view`, `adam`, `sh`, its moments `exp_avg` and `exp_avg_sq`, and `last_step`.
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

fn step_sh(at: u32, gradient: f32, rate: f32, missed: Missed) {
    var m = exp_avg[at];
    var v = exp_avg_sq[at];
    var p = sh[at];
    if (missed.drift != 0.0) {
        p -= rate * missed.drift * m / (sqrt(v) * adam.to_root + adam.epsilon);
    }
    m = m * missed.keep1 * adam.beta1 + gradient * adam.rest1;
    v = v * missed.keep2 * adam.beta2 + gradient * gradient * adam.rest2;
    sh[at] = p - rate * m / (sqrt(v) * adam.to_root + adam.epsilon);
    exp_avg[at] = m;
    exp_avg_sq[at] = v;
}

// The learning rates, with the bias correction, are those of the constant coefficient and of others.
fn update_sh(i: u32, g: Gradient, rates: vec2<f32>) {
    let basis = sh_basis(g.direction);
    let row = 3u * view.sh_coefficients * i;
    let used = sh_count(view.sh_degree);
    let missed = missed_steps(last_step[i]);
    for (var k = 0u; k < kBands; k++) {
        if (k >= used) { continue; }
        let rate = select(rates.y, rates.x, k == 0u);
        for (var channel = 0u; channel < 3u; channel++) {
            step_sh(row + 3u * k + channel, basis[k] * g.rgb[channel], rate, missed);
        }
    }
    last_step[i] = i32(adam.step);
}
