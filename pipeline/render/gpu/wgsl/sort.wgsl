// One pass of a stable radix sort by 4 bits of the keys (least significant digit first): `histogram`
// counts the digits of each block of 1024 keys; after their prefix sum, `scatter` writes keys and
// values to their places. Only integers are added, so the order of additions does not matter.
#import common

struct Pass {
    shift: u32,
    blocks: u32,
}

@group(0) @binding(0) var<uniform> pass_: Pass;
@group(0) @binding(1) var<storage, read> length: u32;  // of the arrays
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read> values: array<u32>;
@group(0) @binding(4) var<storage, read_write> places: array<u32>;  // digit-major
@group(0) @binding(5) var<storage, read_write> sorted_keys: array<u32>;
@group(0) @binding(6) var<storage, read_write> sorted_values: array<u32>;

const kDigits = 16u;
const kEach = 4u;  // consecutive keys per thread

fn digit_of(key: u32) -> u32 {
    return (key >> pass_.shift) & (kDigits - 1u);
}

var<workgroup> counts: array<atomic<u32>, kDigits>;

@compute @workgroup_size(kThreads)
fn histogram(thread: Thread) {
    let block = group_of(thread);
    let first = (block * kThreads + thread.local) * kEach;
    // Some drivers do not zero the memory of workgroups.
    if (thread.local < kDigits) { atomicStore(&counts[thread.local], 0u); }
    workgroupBarrier();
    for (var j = 0u; j < kEach; j++) {
        if (first + j < length) { atomicAdd(&counts[digit_of(keys[first + j])], 1u); }
    }
    workgroupBarrier();
    if (thread.local < kDigits && block < pass_.blocks) {
        places[thread.local * pass_.blocks + block] = atomicLoad(&counts[thread.local]);
    }
}

// Numbers of the digits among the keys of the threads before: 16 counters of 16 bits.
struct Counters {
    low: vec4<u32>,
    high: vec4<u32>,
}
var<workgroup> running: array<Counters, kThreads>;

fn counter(c: Counters, digit: u32) -> u32 {
    let word = digit / 2u;
    let pair = select(c.high[word & 3u], c.low[word & 3u], word < 4u);
    return (pair >> (16u * (digit & 1u))) & 0xffffu;
}

@compute @workgroup_size(kThreads)
fn scatter(thread: Thread) {
    let block = group_of(thread);
    let first = (block * kThreads + thread.local) * kEach;
    var own = Counters(vec4(0u), vec4(0u));
    for (var j = 0u; j < kEach; j++) {
        if (first + j < length) {
            let digit = digit_of(keys[first + j]);
            let word = digit / 2u;
            let one = 1u << (16u * (digit & 1u));
            if (word < 4u) { own.low[word] += one; } else { own.high[word - 4u] += one; }
        }
    }
    running[thread.local] = own;
    for (var step = 1u; step < kThreads; step *= 2u) {
        workgroupBarrier();
        var left = Counters(vec4(0u), vec4(0u));
        if (thread.local >= step) { left = running[thread.local - step]; }
        workgroupBarrier();
        running[thread.local].low += left.low;
        running[thread.local].high += left.high;
    }
    let before = Counters(running[thread.local].low - own.low, running[thread.local].high - own.high);
    for (var j = 0u; j < kEach; j++) {
        if (first + j < length) {
            let key = keys[first + j];
            let digit = digit_of(key);
            var place = places[digit * pass_.blocks + block] + counter(before, digit);
            for (var earlier = 0u; earlier < j; earlier++) {
                place += u32(digit_of(keys[first + earlier]) == digit);
            }
            sorted_keys[place] = key;
            sorted_values[place] = values[first + j];
        }
    }
}
