// What all kernels use: numbers of invocations, bits of numbers, and rows of splats.

const NOWHERE = 0xffffffffu; // the key of a splat that is not visible, behind every depth

struct Place {
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
}

fn group_of(here: Place) -> u32 {
    return here.group.y * here.groups.x + here.group.x;
}

// Of workgroups of 64.
fn number_of(here: Place) -> u32 {
    return group_of(here) * 64 + here.lane;
}

// By its bits: compilers may assume that comparisons see no NaN.
fn is_finite(x: f32) -> bool {
    return (bitcast<u32>(x) & 0x7f800000u) != 0x7f800000u;
}
