"""Which commit changed what a job does: the job run at revisions of its repository."""
