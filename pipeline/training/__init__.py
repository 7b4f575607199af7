"""3D Gaussian splatting (Kerbl et al. 2023), in rooms from data to the loop."""
