"""Compiles every kernel for a GPU that is not here, and reads from the object what it would take.

`python -m tests.raster.gpu_compile cuda:90` prints {kernel: {registers, spills, shared, cpu_s}} as
JSON: all that a run compiles, so a kernel that depends on the SH degree is there for each.
"""

from __future__ import annotations

import json
import re
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import triton
import triton.language as tl
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from stages.raster.gpu import blend, gradients, lists, project
from stages.train.steps import gpu_kernels

FLOATS, DOUBLES, INTS, LONGS, BYTES, SHORTS = "*fp32", "*fp64", "*i32", "*i64", "*i8", "*i16"
POINTERS = {
    **dict.fromkeys(("cam", "sums"), DOUBLES),
    **dict.fromkeys(("members", "last", "counts", "row_of", "steps", "gradient_count"), INTS),
    **dict.fromkeys(("starts", "slots", "firsts", "order", "ordered", "ends", "total"), LONGS),
    **dict.fromkeys(("status",), BYTES),
    **dict.fromkeys(("target",), "*u8"),
    **dict.fromkeys(("tile_of",), SHORTS),
}
WHOLE = (
    *("n", "width", "height", "tiles_x", "tiles", "capacity", "entries", "room"),
    *("columns", "used", "active", "largest_step", "tile"),
)
REALS = ("red", "green", "blue", "weight", "unit", "ndc_x", "ndc_y", "extent", "damping")
SCENE = {"COEFFICIENTS": 16, "SMOOTH": False, "ANTIALIAS": False}
SIZES = {"TILE": 16, "BLOCK": 128, "REAL": tl.float64}
_ROWS = {"BLOCK": 16, "COLUMNS": 64, "WIDTH": 64}
KERNELS: tuple[tuple[Any, dict[str, Any], dict[str, Any]], ...] = (
    (project.project_kernel, {}, {}),
    (project.colour_kernel, {}, {}),
    (lists.count_kernel, {}, {"enable_fp_fusion": False}),
    (lists.entries_kernel, {}, {"enable_fp_fusion": False}),
    (lists.ties_kernel, {}, {}),
    (blend.blend_kernel, {"DEPTHS": False}, {"num_warps": 1}),
    (blend.blend_gradient_kernel, {}, {"num_warps": 1}),
    (blend.contribution_kernel, {}, {"num_warps": 1}),
    (gradients.sum_kernel, {"WIDTH": 9, "BLOCK": 4, "LANES": 8}, {"num_warps": 1}),
    (gradients.colour_gradient_kernel, {}, {}),
    (gradients.splat_gradient_kernel, {}, {}),
    (gpu_kernels.rows_kernel, {"BLOCK": 256}, {}),
    (gpu_kernels.similarity_kernel, {"BLOCK": 256}, {}),
    (gpu_kernels.slope_rows_kernel, {"BLOCK": 256}, {}),
    (gpu_kernels.loss_gradient_kernel, {"BLOCK": 256}, {}),
    (gpu_kernels.move_kernel, {**_ROWS, "GAUSS_NEWTON": True}, {}),
    (gpu_kernels.average_squares_kernel, _ROWS, {}),
)


BY_DEGREE = (project.colour_kernel, gradients.colour_gradient_kernel)


def target_of(name: str) -> GPUTarget:
    """ "cuda:90" or "hip:gfx942"."""
    backend, arch = name.split(":")
    return GPUTarget(
        backend, int(arch) if backend == "cuda" else arch, 32 if arch != "gfx942" else 64
    )


def compiled(kernel: Any, constants: dict[str, Any], options: dict[str, Any], target: str) -> Any:
    """The kernel as a device of this kind would get it; pointers aligned, as torch's are."""
    known = {**SCENE, **SIZES, **constants}
    signature, values, attributes = {}, {}, {}
    for at, parameter in enumerate(kernel.params):
        name = parameter.name
        if parameter.is_constexpr:
            signature[name], values[(at,)] = "constexpr", known[name]
        elif name in WHOLE:
            # otherwise 1 and multiples of 16 are compiled anew
            assert parameter.do_not_specialize, (kernel.__name__, name)
            signature[name] = "i32"
        elif name in REALS or name.startswith("rate_"):
            signature[name] = "fp32"
        else:
            signature[name] = POINTERS.get(name, FLOATS)
            if not parameter.do_not_specialize_on_alignment:
                attributes[(at,)] = [["tt.divisibility", 16]]
    source = ASTSource(kernel, signature, values, attributes)
    return triton.compile(source, target=target_of(target), options=options)


def resources(made: Any) -> dict[str, float]:
    """{registers, spills (bytes of local memory), shared (bytes)} of a compiled kernel."""
    shared = int(made.metadata.shared)
    if "cubin" in made.asm:
        return {**_of_cubin(made.asm["cubin"]), "shared": shared}
    text = made.asm["amdgcn"]

    def entry(name: str) -> int:
        found = re.search(rf"\.{name}:\s+(\d+)", text)
        assert found, name
        return int(found[1])

    return {
        "registers": entry("vgpr_count"),
        "spills": entry("vgpr_spill_count"),
        "shared": shared,
    }


def _of_cubin(cubin: bytes) -> dict[str, float]:
    tool = Path(triton.__file__).parent / "backends/nvidia/bin/cuobjdump"
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(cubin)
        file.flush()
        process = subprocess.run(
            [str(tool), "-res-usage", file.name], capture_output=True, text=True, check=True
        )
    text = process.stdout + process.stderr
    numbers = {name: int(value) for name, value in re.findall(r"(REG|STACK|LOCAL):(\d+)", text)}
    return {"registers": numbers["REG"], "spills": numbers["STACK"] + numbers["LOCAL"]}


def cpu_s() -> float:
    """Of this process and of the assemblers that it ran."""
    both = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return sum(used.ru_utime + used.ru_stime for used in map(resource.getrusage, both))


def main(target: str) -> None:
    found = {}
    kernels = {kernel.__name__: (kernel, *rest) for kernel, *rest in KERNELS}
    for kernel in BY_DEGREE:
        for degree in range(3):
            how = {"COEFFICIENTS": (degree + 1) ** 2}
            kernels[f"{kernel.__name__}, degree {degree}"] = (kernel, how, {})
    kernels["move_kernel, Adam"] = (gpu_kernels.move_kernel, {**_ROWS, "GAUSS_NEWTON": False}, {})
    with tempfile.TemporaryDirectory() as folder:
        triton.knobs.cache.dir = folder
        for name, (kernel, constants, options) in kernels.items():
            before = cpu_s()
            made = compiled(kernel, constants, options, target)
            found[name] = {"cpu_s": round(cpu_s() - before, 2), **resources(made)}
    print(json.dumps(found))


if __name__ == "__main__":
    main(sys.argv[1])
