#import block
#import prefix

// Replaces `count` elements of `values` by their exclusive prefix sums; returns their sum. All
// threads of a workgroup call it.
fn scan_row(lane: Lane, first: u32, count: u32) -> u32 {
    let own = kEach * ordinal(lane);
    var sum = 0u;
    for (var start = 0u; start < count; start += kBlock) {
        var before: array<u32, kEach>;
        var of_thread = 0u;
        for (var j = 0u; j < kEach; j++) {
            before[j] = of_thread;
            if (start + own + j < count) { of_thread += values[first + start + own + j]; }
        }
        let found = prefix(lane, vec2(of_thread, 0u));
        for (var j = 0u; j < kEach; j++) {
            if (start + own + j < count) {
                values[first + start + own + j] = sum + found.before.x + before[j];
            }
        }
        sum += found.total.x;
    }
    return sum;
}
