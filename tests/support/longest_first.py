"""The files of tests that take longest, in the order in which they are begun.

First come three of different kinds: while one compiles kernels, which all others then find compiled, the rest
waits for clocks and browsers. What is not listed takes less than ten seconds and fills the gaps at the end.
"""

_NAMES = """
test_other_cpus.py test_documented_commands.py test_two_hosts.py test_pages.py
test_known_geometry.py test_chaos_short.py test_every_kind.py
test_openapi_fuzz.py test_two_versions.py test_live_page.py test_upheavals.py
test_find.py test_pose_repair.py test_docker_steps.py test_reconstruction.py test_lost_database.py
test_reconstruct_without_poses.py test_worker_recovery.py test_tracers.py test_generated_clients.py
test_event_loop.py test_renders_on_small_disks.py test_half_open_connections.py
test_jobs_without_poses.py test_pipeline_resume.py test_partial_results.py test_dataset.py
test_finite_differences.py test_full_disk.py test_requeued_position.py test_job_limits.py
test_start_refused.py test_splat_transform.py test_cesium.py test_threejs.py test_fusion.py test_lost_locks.py
test_spark.py test_demo.py test_surface.py test_exposure.py test_presets.py test_isolation.py
test_eviction.py test_lights.py test_viewer.py test_threads.py test_front_end_imports.py
test_against_mitsuba.py test_custom_shading_model.py test_brute_force.py test_dense_points.py
test_embedded_postgres.py test_marching.py test_conformance.py test_reference_comparison.py test_uploads.py
test_host_health.py test_hostile_leftovers.py test_disk_limits.py test_retries.py test_sandbox.py
test_client.py test_typed.py test_backup.py test_layouts.py test_materials_page.py test_view_command.py
test_reconstruct.py test_storage_contract.py test_preview.py test_outlier_views.py test_shared_sort.py
"""
LONGEST_FIRST = {name: rank for rank, name in enumerate(_NAMES.split())}
