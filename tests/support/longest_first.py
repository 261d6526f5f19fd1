"""The files of tests that take longest, in the order in which they are begun.

What is not listed takes little and fills the gaps at the end.
"""

_NAMES = """
test_blocks_on_two_hosts.py test_pages.py test_documented_commands.py test_every_kind.py
test_two_versions.py test_worker_recovery.py test_live_page.py test_preview.py test_client.py
test_reconstruction.py test_jobs_without_poses.py test_against_mitsuba.py test_block_scene.py
test_material_trial.py test_block_jobs.py test_compilation.py test_blocks_over_queue.py test_blender.py
test_other_cpus.py test_find.py test_pose_placement.py test_chaos_short.py test_kernel_cache.py
test_generated_clients.py test_evaluate_materials.py test_pose_repair.py test_splat_transform.py
test_request_bounds.py test_retries.py test_deferred.py test_stage_jobs.py test_disk_limits.py
test_lens_check.py test_renders_on_small_disks.py test_pose_refinement.py test_materials_run.py
test_known_geometry.py test_dense_points.py test_start_from.py test_depth_map_training.py
test_half_open_connections.py test_uploads.py test_host_health.py test_start_from_over_queue.py
test_presets.py test_event_loop.py test_embedded_postgres.py test_far_runs.py test_queue_faults.py
test_datasets.py test_ray_gradients.py test_lost_database.py test_relight.py test_hostile_leftovers.py
test_determinism.py test_access_matrix.py test_pipeline_resume.py test_trainer.py test_sandbox.py
test_region.py
"""
LONGEST_FIRST = {name: rank for rank, name in enumerate(_NAMES.split())}
