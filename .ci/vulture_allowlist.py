# What others call or read by name, so that vulture finds no use; .ci/dead-code reads this list, nothing runs it.
# ruff: noqa
# numba asks where compiled kernels are kept
get_cache_path
get_source_stamp
get_disambiguator
from_function
# click and rich draw help and progress
format_epilog
format_commands
get_renderables
# pytest runs the plugin of the mutations
pytest_runtest_logreport
pytest_runtestloop
# io.RawIOBase and Pillow read files
seekable
readinto
# http.server
daemon_threads
# fields that become JSON, CSV or variables of a template by their names
result_size
ssim_valid
psnr_foreground
triangles_found
turned_deg
shifted_world
x_range
y_range
higher_is_better
experimental
formats
needs_token
isolation
disabled_reason
message_id
deliveries
# ceilings that service/job_limits.py reads by their names
max_iterations
max_exports
max_render_pixels
max_render_paths
# the Python API: users call it
download
# measures of surfaces, which tests and users' programs take
surface_metrics
chamfer
f_score
# places of a row, of which not each is addressed
NORMAL_1
NORMAL_2
GRAD_BLUE
GRAD_GREEN
# typed by the annotations of kernels, which numba reads itself
camera_tables
exponents
# tests call kernels of single rays and samples over arrays, and read paths of cameras back
light_samples
principled_eval_array
principled_sample_array
fresnel_values
rough_dielectric_eval_array
rough_dielectric_sample_array
fill_uniform
read_camera_path
DIELECTRIC_F0
# keys of transforms files, read by their names or known so that they are not told as unused
camera_angle_x
camera_angle_y
fl_x
fl_y
is_fisheye
train_filenames
# of the OpenAPI document: headers of messages to webhooks, fields of answers
webhook_timestamp
webhook_signature
job_seconds
stage_seconds
total_seconds_left
resolved_by
map_position
