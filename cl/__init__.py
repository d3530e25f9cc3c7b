"""The OpenCL sources, one .cl file a stage; this file lets them be packaged as ``psf_cl.cl``."""
