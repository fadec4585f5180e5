"""Find the commit that changed a job's run: run the job at revisions of its repository."""
