"""CUDA graphs: capture, replay, keys of captured graphs and their memory."""
