"""One triangle mesh of a scene: depth maps that the tracer renders, fused into a signed distance volume.

cameras -> depth maps -> sparse volume -> marching cubes -> clean-up -> decimation -> colours -> file
"""
