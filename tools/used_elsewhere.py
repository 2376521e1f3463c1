"""Names that no product code reads, but that are used elsewhere; vulture reads this file, too (`tools/check`).

Each line states the user of the name. A function that only tests call must not be listed here: it gets a user, or
it is removed. The last lines are the exception: faults that tests inject into stand-ins, and their state that
tests read.
"""
# ruff: noqa: B018, F821
# mypy: disable-error-code="name-defined"

# ---- by name ----
_.list_commands, _.epilog  # typer, for its help
_.doctor, _.archive, _.sim, _.demo  # GROUPS of coupole/commands/cli.py
_.TextLineBox  # named in rigs, as drivers are
_.MemoryCamera  # named in rigs
_.export_scan, _.Stills, _.measure_jitter  # named in coupole/plan/registry.py
_._do_limits, _._do_memory, _._do_trigger, _._do_statistics, _._do_disarm  # CameraServer, by the message's verb
_._write_command, _._write_enumeration, _._write_string, _._write_boolean  # Features, by the node's kind
_._write_integer, _._write_float  # the same
_.relight_uncertainty, _.PicturesResult, _.Acquisition, _.__dir__  # users of the Python interface
_.__getattr__  # drivers/kuka/rsi, drivers/ur: Python, for names that are imported on first use
_.open_run, _.open_result, _.open_cell, _.fit_reflectance  # coupole/__init__.py, by its table
_.residual_rms_us, _.residual_max_us  # the report, coupole/viewing/report_facts.py
_.white_at_us  # coupole/preflight/simulated_world.py, in the rig's settings
_.href, _.alternative, _.is_broad, _.shade_png, _.numeric_columns, _.figure_size  # coupole/pages/templates
_.is_folded, _.quality, _.next_step, _.shown_sections, _.is_cut  # the same
_.adaptive, _.author, _.refined  # ExportOptions.given_options, which lists all fields

# ---- by files that are written from all fields ----
_.acknowledged, _.joints_before_deg, _.joints_after_deg, _.table_s  # lines of the journal
_.entered  # entries of the console's queue
_.stored, _.chosen_in_the_run  # run.json

# ---- by equality of the whole ----
_.colour_index  # read_classes refuses a name with two of them

# ---- by libraries ----
_.pix_fmt, _.color_primaries, _.colorspace, _.color_range, _.color_trc  # PyAV
_.preserve_quotes, _.warn_double_anchors, _.default_flow_style, _.sort_base_mapping_type_on_output  # ruamel.yaml
_.__signature__, _.__annotations__  # typer
_.ssl_context_factory, _.should_exit  # uvicorn
_.decorations  # CodeMirror's options
_.redirect_request  # urllib
_.daemon_threads, _.request_queue_size, _.service_actions  # socketserver
_.server_version, _.sys_version, _.do_GET, _.do_POST  # http.server
_.send_error, _.explain, _.close_connection, _.log_message  # http.server
_.writable  # io
_.writeable  # numpy
_._LanesModel  # numba, by its decorator
_._cache, _._py_file  # numba
_.get_cache_path, _.get_source_stamp, _.get_disambiguator, _.from_function  # numba, of kept_code.py
_.timeout_period_on_update_event_data_call, _.num_buffers  # harvesters
_.current_position, _.current_velocity, _.current_acceleration, _.control_interface  # ruckig
_.target_position, _.target_velocity, _.target_acceleration  # ruckig
_.max_velocity, _.max_acceleration, _.max_jerk  # ruckig
_.break_condition, _.write_timeout  # pyserial

# ---- by tools/ ----
_.burst_times_s  # bench.py sequencing
_.u_seen  # prove_layers.py
_.BEAT_MS, _.COMMAND_ELEMENTS, _.STATUS_ELEMENTS  # make_kuka_files.py, for the controller's files

_.describe_collect, _.collect_asset_docs, _.get_index, _.success  # bluesky: DomeCell, ProvenFrames
_.run_folder, _.take_view  # users of coupole/neighbours/bluesky.py
_.m_max_partitions  # etcpak: parameter of BC7

# ---- by tests alone ----
_.LEFT_BY_SFNC, _.is_safe, _.light_given_s  # coupole/testing, for the tests of other projects
_.switch_panel, _.ledbox_alone, _.RobotAlone  # sim/world, for these tests and for ours
_.safeguard_stop, _.safety_fault, _.stop_program, _.drop_link  # faults of the simulated UR controller
_.ended_programs  # the simulated RSI controller: how often a client has ended its program
_.ambiguous  # Match: whether frames were left open; people are told the reason
