"""Who works on the files of a data set: processes of this machine, or a Ray cluster."""
