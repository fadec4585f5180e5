"""The trace file: what is in it (``format``), how it is written, how it is read. No ROS needed.

``writer.TraceWriter`` and ``reader.Trace`` are the two things the rest of rsltrace uses;
``docs/trace-format.md`` describes the file for everybody else.
"""
