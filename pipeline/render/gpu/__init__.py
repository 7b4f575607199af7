"""The backend of WebGPU kernels (WGSL), for any GPU with Vulkan, Metal or Direct3D 12.

``device.py`` opens the device and runs kernels, ``kernels.py`` reads their sources, and
``layout.py`` defines how data lies in buffers. ``primitives.py``, ``rasterise.py``, ``loss.py`` and
``adam.py`` run the kernels on buffers. Two interfaces of ``pipeline.render`` are built on them:
``backend.py`` copies tensors to the device and back, and ``resident.py`` keeps them there during
training.
"""
