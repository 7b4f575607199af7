"""Training of 3D Gaussians (Kerbl et al. 2023).

``data``, ``losses``, ``optimisers``, ``cameras`` (refinement), ``density`` (control) and
``checkpoints`` are the parts; ``loop`` runs the steps, and ``scene`` trains a whole scene.
"""
