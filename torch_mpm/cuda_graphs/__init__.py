"""CUDA graphs: capture, replay, keys of recordings and their memory."""
