// A stable radix sort, four bits a pass: `count` counts the digits of each block of 1024 keys, a scan
// turns the counts into places, and `scatter` moves keys and values there. A lane has 16 keys that
// follow each other and a column of counts of its own, so that nothing is counted by atomics.

//include common.wgsl

const LANES = 64u;
const ITEMS = 16u;
const DIGITS = 16u;

struct Numbers {
    n: u32,
    shift: u32,
    blocks: u32,
    numbered: u32, // 1 in the first pass: the values are the places of the keys
}

@group(0) @binding(0) var<uniform> given: Numbers;
@group(0) @binding(1) var<storage, read_write> keys: array<u32>;
@group(0) @binding(2) var<storage, read_write> table: array<u32>; // [DIGITS, blocks]
@group(0) @binding(3) var<storage, read_write> values: array<u32>;
@group(0) @binding(4) var<storage, read_write> new_keys: array<u32>;
@group(0) @binding(5) var<storage, read_write> new_values: array<u32>;
var<workgroup> counts: array<u32, 1024>; // [DIGITS, LANES]

fn digit(i: u32) -> u32 {
    return (keys[i] >> given.shift) & (DIGITS - 1);
}

fn count_digits(block: u32, lane: u32) {
    for (var d = 0u; d < DIGITS; d++) {
        counts[d * LANES + lane] = 0;
    }
    let first = (block * LANES + lane) * ITEMS;
    for (var i = first; i < min(given.n, first + ITEMS); i++) {
        counts[digit(i) * LANES + lane]++;
    }
    workgroupBarrier();
}

@compute @workgroup_size(LANES)
fn count(here: Place) {
    let lane = here.lane;
    let block = group_of(here);
    count_digits(block, lane);
    if (lane < DIGITS && block < given.blocks) {
        var total = 0u;
        for (var k = 0u; k < LANES; k++) {
            total += counts[lane * LANES + k];
        }
        table[lane * given.blocks + block] = total;
    }
}

@compute @workgroup_size(LANES)
fn scatter(here: Place) {
    let lane = here.lane;
    let block = group_of(here);
    count_digits(block, lane);
    if (lane < DIGITS && block < given.blocks) {
        var place = table[lane * given.blocks + block];
        for (var k = 0u; k < LANES; k++) {
            let found = counts[lane * LANES + k];
            counts[lane * LANES + k] = place;
            place += found;
        }
    }
    workgroupBarrier();
    let first = (block * LANES + lane) * ITEMS;
    for (var i = first; i < min(given.n, first + ITEMS); i++) {
        let column = digit(i) * LANES + lane;
        let place = counts[column];
        counts[column] = place + 1;
        new_keys[place] = keys[i];
        if (given.numbered != 0) {
            new_values[place] = i;
        } else {
            new_values[place] = values[i];
        }
    }
}
