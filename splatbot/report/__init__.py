"""Reports and pictures: HTML pages, plots, and views with robots, grasps and objects."""
