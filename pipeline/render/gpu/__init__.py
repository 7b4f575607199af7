"""The backend of WebGPU kernels (WGSL), for any GPU with Vulkan, Metal or Direct3D 12.

``device.py`` opens the device and runs kernels, ``kernels.py`` reads their sources, ``layout.py``
says how data lies in buffers, ``sort.py`` and ``rasterise.py`` are sequences of kernels, and
``backend.py`` is the interface of ``pipeline.render``.
"""
