"""A Model Context Protocol server: the commands and the debugger as tools of an agent.

``tools`` has a method for each tool. Tools run the commands of rsltrace in processes
(``commands``), read an event of a trace in a process (``event_page``), or use a ``DebugSession``
(``sessions``). ``access`` says which files they may touch and whether nodes may run, ``answers``
keeps every answer short. Only ``server`` imports the package ``mcp``.
"""
