"""The rate of multiply-adds of a GPU."""

from __future__ import annotations

from benchmarks.gpu import median_seconds
from pipeline.render.gpu.device import THREADS, Gpu

GROUPS = 2048
ROUNDS = 512
CHAINS = 8  # Independent multiply-adds, so that none depends on the result of the last one.
SOFTWARE_SHARE = 64  # The work on a device in software is divided by this.


def arithmetic(gpu: Gpu) -> float:
    """The float32 operations per second, a multiply-add being two."""
    groups = GROUPS // SOFTWARE_SHARE if gpu.adapter.kind == "software" else GROUPS
    names = [f"x{i}" for i in range(CHAINS)]
    start = "\n".join(f"var {name} = f32(id.x) * 1e-9 + {i}.0;" for i, name in enumerate(names))
    turn = "\n".join(f"{name} = fma({name}, factor, term);" for name in names)
    code = f"""
@group(0) @binding(0) var<storage, read_write> values: array<f32>;
@compute @workgroup_size({THREADS})
fn main(@builtin(global_invocation_id) id: vec3<u32>) {{
    let factor = values[0];
    let term = values[1];
    {start}
    for (var i = 0u; i < {ROUNDS}u; i++) {{ {turn} }}
    values[id.x + 2u] = {" + ".join(names)};
}}
"""
    device = gpu.device
    buffer = gpu.empty(4 * (groups * THREADS + 2))
    pipeline = device.create_compute_pipeline(
        layout="auto",
        compute={"module": device.create_shader_module(code=code), "entry_point": "main"},
    )
    bound = device.create_bind_group(
        layout=pipeline.get_bind_group_layout(0),
        entries=[{"binding": 0, "resource": {"buffer": buffer, "offset": 0, "size": buffer.size}}],
    )

    def run() -> None:
        encoder = device.create_command_encoder()
        each = encoder.begin_compute_pass()
        each.set_pipeline(pipeline)
        each.set_bind_group(0, bound)
        each.dispatch_workgroups(groups)
        each.end()
        device.queue.submit([encoder.finish()])
        gpu.read(buffer, "f4", 1)

    return groups * THREADS * ROUNDS * CHAINS * 2 / median_seconds([run], 5)[0]
