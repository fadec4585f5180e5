"""Call stacks of user code: blocking calls, tasks, threads, locks, asyncio, mains."""
