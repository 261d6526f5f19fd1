"""The files of tests that take longest, in the order in which they are begun.

First come three of different kinds: while one compiles kernels, which all others then find compiled, the rest
waits for clocks and browsers. What is not listed takes less than ten seconds and fills the gaps at the end.
"""

_NAMES = """
test_other_cpus.py test_two_hosts.py test_pages.py
test_known_geometry.py test_chaos_short.py test_find.py test_misplaced.py
test_docker_steps.py test_reconstruction.py test_cut_off.py test_bare_folder.py test_worker_recovery.py
test_tracers.py test_openapi_fuzz.py test_bare_photographs.py test_pipeline_resume.py test_partial_results.py
test_dataset.py test_finite_differences.py test_full_disk.py test_kept_place.py test_job_limits.py
test_start_refused.py test_splat_transform.py test_threejs.py test_fusion.py test_lost_locks.py test_spark.py
test_demo.py test_surface.py test_exposure.py test_presets.py test_isolation.py test_making_room.py
test_lights.py test_viewer.py test_threads.py test_front_end_is_light.py test_against_mitsuba.py test_seam.py
test_brute_force.py test_dense_points.py test_embedded_postgres.py test_marching.py test_conformance.py
test_twin.py test_uploads.py test_reconstruct.py test_contract.py test_preview.py test_misfits.py
test_one_order.py
"""
LONGEST_FIRST = {name: rank for rank, name in enumerate(_NAMES.split())}
