"""The files of a data set: found, claimed, worked on, and what is done of them kept."""
