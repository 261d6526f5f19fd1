"""Surface meshes of scenes: traced depth maps, fused into a truncated signed distance volume.

cameras -> depth maps -> sparse volume -> marching cubes -> clean-up -> decimation -> colors -> file
"""
