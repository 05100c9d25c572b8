// Footprints of splats: what the forward and the backward pass both compute, as in the reference.
//
// Float32 holds the products of covariances of wide splats only in units of the splat's own size:
// a footprint is in units of `size` pixels, a power of two.

// camera_row, then what a kernel needs of rows of splats
struct View {
    cam: array<vec4<f32>, 7>,
    n: u32,
    columns: u32,
    used: u32, // columns of a row that hold parameters
    smoothed: u32,
    tile: u32,
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> rows: array<f32>;
@group(0) @binding(2) var<storage, read> smoothing: array<f32>;

struct Footprint {
    at: vec3<f32>, // in the camera
    slopes: vec2<f32>, // x/z and y/z within their limits
    inside: vec2<bool>, // whether they are
    axes: mat3x3<f32>, // the splat's axes in camera axes
    quaternion: vec4<f32>, // unit, w first
    norm: f32,
    scales: vec3<f32>, // in units of size
    ratios: vec3<f32>, // of the scales without the smoothing filter to those with it
    size: f32,
    x: vec3<f32>, // rows of V = J W R diag(s)
    y: vec3<f32>,
    a: f32,
    b: f32,
    c: f32,
    root: f32, // of the determinant
    area: f32, // root of the determinant without dilation
    dilation: f32,
    opacity: f32, // as drawn
    mean: vec2<f32>, // pixels
}

// Its columns are the rows of the rotation from the world to the camera.
fn rotation() -> mat3x3<f32> {
    let c = view.cam;
    return mat3x3(c[0].xyz, vec3(c[0].w, c[1].xy), vec3(c[1].zw, c[2].x));
}

fn turned(v: vec3<f32>) -> vec3<f32> {
    return v * rotation();
}

fn triple(at: u32) -> vec3<f32> {
    return vec3(rows[at], rows[at + 1], rows[at + 2]);
}

fn position(at: u32) -> vec3<f32> {
    return turned(triple(at + MEAN)) + view.cam[2].yzw;
}

fn held(x: vec2<f32>) -> vec2<f32> {
    return clamp(x, vec2(-1e37), vec2(1e37));
}

// The footprint of the splat in front of the camera whose row begins at `at`, number i.
fn footprint(at: u32, i: u32) -> Footprint {
    var f: Footprint;
    f.at = position(at);
    let focal = view.cam[3].xy;
    let limits = view.cam[4];
    let slopes = f.at.xy / f.at.z;
    f.slopes = clamp(slopes, limits.xz, limits.yw);
    f.inside = f.slopes == slopes;
    f.mean = held(focal * slopes + view.cam[3].zw);
    let q = vec4(triple(at + ROTATION), rows[at + ROTATION + 3]);
    let top = max(max(abs(q.x), abs(q.y)), max(abs(q.z), abs(q.w)));
    let scaled = q / top;
    let norm = sqrt(dot(scaled, scaled)); // length() may lose digits
    f.quaternion = scaled / norm;
    f.norm = norm * top;
    let w = f.quaternion.x;
    let v = f.quaternion.yzw;
    let r = 2 * v.yzx * v.zxy; // yz, zx, xy
    let s = 2 * v * v;
    let t = 2 * w * v;
    f.axes = mat3x3(
        turned(vec3(1 - s.y - s.z, r.z + t.z, r.y - t.y)),
        turned(vec3(r.z - t.z, 1 - s.x - s.z, r.x + t.x)),
        turned(vec3(r.y + t.y, r.x - t.x, 1 - s.x - s.y)),
    );
    f.scales = exp(triple(at + LOG_SCALE));
    f.ratios = vec3(1.0);
    if (view.smoothed != 0) {
        let width = vec3(smoothing[i]);
        let larger = max(f.scales, width);
        let quotient = min(f.scales, width) / larger;
        let widened = larger * sqrt(1 + quotient * quotient);
        f.ratios = f.scales / widened;
        f.scales = widened;
    }
    let axes = transpose(f.axes);
    f.x = focal.x / f.at.z * (axes[0] - f.slopes.x * axes[2]) * f.scales;
    f.y = focal.y / f.at.z * (axes[1] - f.slopes.y * axes[2]) * f.scales;
    measure(&f);
    let kept = f.ratios.x * f.ratios.y * f.ratios.z;
    f.opacity = kept / (1 + exp(-rows[at + OPACITY]));
    if (view.cam[5].z != 0) {
        f.opacity *= f.area / f.root;
    }
    return f;
}

// The covariance, from rows of V in pixels, which come into units of size.
fn measure(f: ptr<function, Footprint>) {
    let e = view.cam[5].y;
    let both = max(abs((*f).x), abs((*f).y));
    let largest = max(max(max(both.x, both.y), max(both.z, sqrt(e))), 1e-15);
    (*f).size = bitcast<f32>(bitcast<u32>(largest) & 0x7f800000u);
    let unit = 1 / (*f).size;
    (*f).x *= unit;
    (*f).y *= unit;
    (*f).scales *= unit;
    let a = dot((*f).x, (*f).x);
    let c = dot((*f).y, (*f).y);
    (*f).dilation = e * unit * unit;
    (*f).a = a + (*f).dilation;
    (*f).b = dot((*f).x, (*f).y);
    (*f).c = c + (*f).dilation;
    let minors = cross((*f).x, (*f).y);
    (*f).area = norm(vec4(minors, 0.0));
    (*f).root = norm(vec4(minors, sqrt(e) * unit * sqrt(a + c + (*f).dilation)));
}

// No square overflows or vanishes.
fn norm(v: vec4<f32>) -> f32 {
    let parts = abs(v);
    let largest = max(max(max(parts.x, parts.y), max(parts.z, parts.w)), 1e-37);
    return largest * sqrt(dot(parts / largest, parts / largest));
}

// The unit vector from the camera to a splat, and the distance.
fn direction(at: u32) -> vec4<f32> {
    let offset = triple(at + MEAN) - vec3(view.cam[5].w, view.cam[6].xy);
    let largest = max(max(abs(offset.x), abs(offset.y)), abs(offset.z));
    let scaled = offset / largest; // no square overflows or vanishes
    let distance = sqrt(dot(scaled, scaled));
    return vec4(scaled / distance, distance * largest);
}

// Real spherical harmonics of a unit direction: see stages/raster/sh.py.
fn basis(d: vec3<f32>) -> array<f32, 16> {
    let x = d.x;
    let y = d.y;
    let z = d.z;
    let s = d * d;
    return array(
        C0,
        -C1 * y, C1 * z, -C1 * x,
        C20 * x * y, -C20 * y * z, C21 * (2 * s.z - s.x - s.y), -C20 * x * z, C22 * (s.x - s.y),
        -C30 * y * (3 * s.x - s.y), C31 * x * y * z, -C32 * y * (4 * s.z - s.x - s.y),
        C33 * z * (2 * s.z - 3 * s.x - 3 * s.y), -C32 * x * (4 * s.z - s.x - s.y),
        C34 * z * (s.x - s.y), -C30 * x * (s.x - 3 * s.y),
    );
}

// Their gradients with respect to the direction before its normalisation.
fn basis_slopes(d: vec3<f32>) -> array<vec3<f32>, 16> {
    let x = d.x;
    let y = d.y;
    let z = d.z;
    let s = d * d;
    let t = 4 * s.z - s.x - s.y;
    return array(
        vec3(0.0),
        vec3(0, -C1, 0), vec3(0, 0, C1), vec3(-C1, 0, 0),
        C20 * vec3(y, x, 0), -C20 * vec3(0, z, y), 2 * C21 * vec3(-x, -y, 2 * z),
        -C20 * vec3(z, 0, x), 2 * C22 * vec3(x, -y, 0),
        -3 * C30 * vec3(2 * x * y, s.x - s.y, 0), C31 * vec3(y * z, x * z, x * y),
        -C32 * vec3(-2 * x * y, t - 2 * s.y, 8 * y * z),
        3 * C33 * vec3(-2 * x * z, -2 * y * z, 2 * s.z - s.x - s.y),
        -C32 * vec3(t - 2 * s.x, -2 * x * y, 8 * x * z),
        C34 * vec3(2 * x * z, -2 * y * z, s.x - s.y), -3 * C30 * vec3(s.x - s.y, -2 * x * y, 0),
    );
}
