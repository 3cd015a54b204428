"""The CPU kernels, one module for each stage; nothing here knows of torch."""
