// One pass of a stable radix sort by 8 bits of the keys (least significant digit first), which
// leaves out keys of zero. `histogram` counts the digits of each block of keys, and `scan` adds those
// of the blocks before. `scatter` sorts each block in the workgroup's memory, by two bits at a time,
// and writes the runs of equal digits to their places. Only integers are added, so the order of
// additions does not matter.
#import common

struct Pass {
    shift: u32,  // of the digit
}

@group(0) @binding(0) var<uniform> pass_: Pass;
@group(0) @binding(1) var<storage, read> length: u32;  // of the arrays
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read> order: array<u32>;  // not read by the first pass
@group(0) @binding(4) var<storage, read_write> places: array<u32>;  // of digits, by block
@group(0) @binding(5) var<storage, read_write> totals: array<u32>;  // of the digits
@group(0) @binding(6) var<storage, read_write> sorted_keys: array<u32>;
@group(0) @binding(7) var<storage, read_write> sorted_order: array<u32>;
@group(0) @binding(8) var<storage, read_write> count: u32;  // of sorted keys: by the first pass
#import block
#import prefix

const kDigits = kThreads;  // A thread takes a digit of the tables.
const kNone = 0xffffffffu;

fn digit_of(key: u32) -> u32 {
    return (key >> pass_.shift) & (kDigits - 1u);
}

var<workgroup> counts: array<atomic<u32>, kDigits>;

@compute @workgroup_size(kThreads)
fn histogram(thread: Thread) {
    let block = group_of(thread);
    let first = block * kBlock + thread.local;
    if (block * kBlock >= length) { return; }
    // Some drivers do not zero the memory of workgroups.
    atomicStore(&counts[thread.local], 0u);
    workgroupBarrier();
    for (var i = first; i < min(length, first + kBlock); i += kThreads) {
        if (keys[i] != 0u) { atomicAdd(&counts[digit_of(keys[i])], 1u); }
    }
    workgroupBarrier();
    places[block * kDigits + thread.local] = atomicLoad(&counts[thread.local]);
}

// A workgroup scans kScanned digits; for each, kParts threads take consecutive blocks.
const kScanned = 8u;
const kParts = kThreads / kScanned;
var<workgroup> parts: array<u32, kThreads>;

@compute @workgroup_size(kThreads)
fn scan(thread: Thread) {
    let column = thread.local % kScanned;
    let digit = group_of(thread) * kScanned + column;
    let part = thread.local / kScanned;
    let blocks = blocks_of(length);
    let each = (blocks + kParts - 1u) / kParts;
    let begin = min(part * each, blocks);
    let end = min(begin + each, blocks);
    var sum = 0u;
    for (var block = begin; block < end; block++) { sum += places[block * kDigits + digit]; }
    parts[thread.local] = sum;
    workgroupBarrier();
    var place = 0u;
    for (var before = 0u; before < part; before++) { place += parts[before * kScanned + column]; }
    if (part == kParts - 1u) { totals[digit] = place + sum; }
    for (var block = begin; block < end; block++) {
        let found = places[block * kDigits + digit];
        places[block * kDigits + digit] = place;
        place += found;
    }
}

// Four numbers of 16 bits, by two bits of the digit.
fn one_of(bits: u32) -> vec2<u32> {
    let one = 1u << (16u * (bits & 1u));
    return select(vec2(one, 0u), vec2(0u, one), bits >= 2u);
}
fn number_at(numbers: vec2<u32>, bits: u32) -> u32 {
    return (select(numbers.x, numbers.y, bits >= 2u) >> (16u * (bits & 1u))) & 0xffffu;
}
// The exclusive prefix sums of the four.
fn prefix_of_four(numbers: vec2<u32>) -> vec2<u32> {
    let half = (numbers.x & 0xffffu) + (numbers.x >> 16u);
    return (numbers << vec2(16u)) + vec2(0u, half | (half << 16u));
}

// The keys of the block: the digit and, in the lower 16 bits, the place in the block.
var<workgroup> entries: array<u32, kBlock>;
// The place of the first key of each digit, less its place in `entries`.
var<workgroup> starts: array<u32, kDigits>;

// Sorts `entries` without those of kNone; returns the number of the others.
fn sort_block(lane: Lane) -> u32 {
    let own = kEach * ordinal(lane);
    var used = kBlock;
    for (var shift = 16u; shift < 24u; shift += 2u) {
        workgroupBarrier();
        var mine: array<u32, kEach>;
        var found = vec2(0u);
        for (var j = 0u; j < kEach; j++) {
            mine[j] = kNone;
            if (own + j < used) { mine[j] = entries[own + j]; }
            if (mine[j] != kNone) { found += one_of((mine[j] >> shift) & 3u); }
        }
        let sums = prefix(lane, found);
        var next = sums.before + prefix_of_four(sums.total);
        for (var j = 0u; j < kEach; j++) {
            if (mine[j] != kNone) {
                let bits = (mine[j] >> shift) & 3u;
                entries[number_at(next, bits)] = mine[j];
                next += one_of(bits);
            }
        }
        let half = sums.total.x + sums.total.y;
        used = (half & 0xffffu) + (half >> 16u);
    }
    workgroupBarrier();
    return used;
}

@compute @workgroup_size(kThreads)
fn scatter(thread: Thread, lane: Lane) {
    let block = group_of(thread);
    let first = block * kBlock;
    if (block > 0u && first >= length) { return; }
    let digit = ordinal(lane);
    let of_digits = prefix(lane, vec2(totals[digit], 0u));
    starts[digit] = of_digits.before.x + places[block * kDigits + digit];
    if (block == 0u && digit == 0u && pass_.shift == 0u) {
        count = of_digits.total.x;
    }
    for (var at = thread.local; at < kBlock; at += kThreads) {
        var entry = kNone;
        if (first + at < length) {
            let key = keys[first + at];
            if (key != 0u) { entry = (digit_of(key) << 16u) | at; }
        }
        entries[at] = entry;
    }
    let used = sort_block(lane);
    for (var at = thread.local; at < used; at += kThreads) {
        let digit = entries[at] >> 16u;
        if (at == 0u || entries[at - 1u] >> 16u != digit) { starts[digit] -= at; }
    }
    workgroupBarrier();
    for (var at = thread.local; at < used; at += kThreads) {
        let place = starts[entries[at] >> 16u] + at;
        let i = first + (entries[at] & 0xffffu);
        sorted_keys[place] = keys[i];
        if (pass_.shift == 0u) {
            sorted_order[place] = i;
        } else {
            sorted_order[place] = order[i];
        }
    }
}
