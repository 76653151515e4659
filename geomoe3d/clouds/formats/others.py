"""What files of other kinds are, by their suffix, and what helps."""

from __future__ import annotations

_KINDS = {
    "an archive; unpack it first": ".zip .7z .rar .tar .tgz .bz2 .xz .zst",
    "a scanner maker's project; export it as E57, PTX or LAS": (
        ".rcp .rcs .fls .lsproj .zfs .fws .rdbx .rxp .imp .cl3 .dp .tzf .3dd .clr .nctri .lgs .lgsx"
    ),
    "a recording of a sensor; export single sweeps as PCD or PLY": ".pcap .pcapng .bag .db3 .mcap .osf .lvx .lvx2",
    "VTK's XML; save it as legacy .vtk or as PLY": ".vtp .vtu .vti .vts .vtr .vtm",
    "a model of another program; export it as OBJ, PLY or GLB": (
        ".dae .fbx .3ds .blend .usd .usdz .usda .usdc .wrl .x3d .3mf .step .stp .iges .igs .ifc .dwg "
        ".dxf .skp .max .rvt"
    ),
    "an image or a raster; turn it into points first": (
        ".png .jpg .jpeg .bmp .tif .tiff .exr .dem .ecw .jp2 .hgt .grd .raw .bil"
    ),
    "a tile of a web map; export the points as LAS or PLY": ".b3dm .i3dm .pnts .cmpt",
    "a set of Gaussian splats; export it as PLY": ".splat .ksplat .spz .sog",
    "a map of points and lines; export it as CSV with columns x, y, z": ".shp .gpkg .geojson .kml .kmz .gpx .gdb",
    "a spreadsheet; save it as CSV": ".xls .xlsx .ods .numbers",
    "a document; scans come as PLY, LAS, E57, ...": ".doc .docx .pdf .odt .html .md",
    "a trajectory; scans come as PLY, LAS, E57, ...": ".sbet .trj .pos .nmea",
    "most likely rows of numbers; rename it to .txt if it is text": (
        ".dat .pnt .neu .xyzrgb .xyzn .xyzi .xyzirgb .xyb .3d .pt3 .points .out .tab .tsv .prn"
    ),
    "a cloud in PCL's sense; save it as .pcd": ".pcl",
    "compressed LAS; its name should end with .laz, or .copc.laz": ".copc .laszip .lasz",
    "pickled Python, which can run anything and is not read; save an array as .npy": ".pkl .pickle .pth .pt",
    "a container of arrays; save the points as .npy": ".h5 .hdf5 .mat .parquet .feather .zarr .nc",
    "a map of `geomoe3d index`, in which `geomoe3d locate SCAN MAP` finds scans; clouds here": ".map",
    "a transform or settings; clouds come first": ".json .yaml .yml .toml .xml .tum .kitti",
}
MEANT = {what: tuple(suffixes.split()) for what, suffixes in _KINDS.items()}
"""Suffixes by what is said of them: "'a.zip' is " + key."""
