"""OpenCL: choosing devices, building and launching kernels, arrays on the device, scans, profiling."""
