"""What computes operations of the renderer and of its training: the engines of the CPU and of NVIDIA GPUs."""
