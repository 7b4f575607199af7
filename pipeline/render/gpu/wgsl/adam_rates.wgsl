// The constants of a step of Adam (AdamRates in types.py). Learning rates include the bias
// correction.
struct Adam {
    count: u32,      // of the elements, rows or Gaussians
    width: u32,      // elements of a row
    num_rates: u32,
    at: u32,         // first elements of the parameter, its gradient and its moments in their arrays
    gradient_at: u32,
    moments_at: u32,
    flags: u32,
    step: u32,
    rate0: f32,      // the first two rates
    rate1: f32,
    beta1: f32,
    beta2: f32,
    rest1: f32,      // 1 - beta1
    rest2: f32,
    epsilon: f32,
    to_root: f32,    // bias correction of the root of the second moment
    ratio: f32,      // beta1 / sqrt(beta2)
}
