"""One self-contained web page of result archives: `ekfslam.page.report`, what it holds `ekfslam.page.content`."""
