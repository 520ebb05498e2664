"""What recordings of CUDA graphs share."""
