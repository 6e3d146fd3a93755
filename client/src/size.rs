//! Sizes and counts as people write and read them: `2G`, `512M`; "1.5 GiB"; `20M` points.

const UNITS: [(char, u32); 4] = [('K', 10), ('M', 20), ('G', 30), ('T', 40)];

/// Reads a size in bytes: a number with an optional K, M, G or T (powers of 1024), itself with an optional `B` or `iB`.
///
/// # Errors
/// What is wrong, with an example of what would be right.
pub fn parse_bytes(text: &str) -> Result<u64, String> {
    let fault = || format!("{text:?} is no size: write a number with K, M, G or T, such as 2G or 512M");
    let upper = text.trim().to_ascii_uppercase();
    let bare = upper.strip_suffix("IB").or(upper.strip_suffix('B')).unwrap_or(&upper);
    let unit = UNITS.iter().find(|(letter, _)| bare.ends_with(*letter));
    let (digits, shift) = match unit {
        Some((_, shift)) => (&bare[..bare.len() - 1], *shift),
        None => (bare, 0),
    };
    let value = number(digits).ok_or_else(fault)?;
    let bytes = value * (1u64 << shift) as f64;
    if bytes < 1.0 {
        return Err(format!("{text:?} is no size: it must be above 0"));
    }
    if bytes >= (1u64 << 53) as f64 {
        return Err(format!("{text:?} is more than any machine has"));
    }
    Ok(bytes as u64)
}

/// Reads how many of something: a number with an optional k, M or G (thousands, millions, billions), at least 1.
///
/// # Errors
/// What is wrong, with an example of what would be right.
pub fn parse_count(text: &str) -> Result<u64, String> {
    let fault = || format!("{text:?} is no count: write a whole number from 1 up, or one with k, M or G, such as 20M");
    let upper = text.trim().to_ascii_uppercase();
    let unit = UNITS[..3].iter().position(|(letter, _)| upper.ends_with(*letter));
    let (digits, unit) = match unit {
        Some(unit) => (&upper[..upper.len() - 1], 1000f64.powi(unit as i32 + 1)),
        None => (&upper[..], 1.0),
    };
    let count = number(digits).ok_or_else(fault)? * unit;
    if count >= 1.0 && count < (1u64 << 53) as f64 && count.fract() == 0.0 {
        Ok(count as u64)
    } else {
        Err(fault())
    }
}

/// A number of digits and at most one point.
fn number(digits: &str) -> Option<f64> {
    let plain = !digits.is_empty() && digits.chars().all(|c| c.is_ascii_digit() || c == '.');
    digits.parse().ok().filter(|_| plain)
}

/// A size for people: the number, and its unit.
pub fn scaled_bytes(bytes: f64) -> (f64, &'static str) {
    const NAMES: [&str; 5] = ["B", "KiB", "MiB", "GiB", "TiB"];
    let mut value = bytes;
    let mut name = 0;
    while value >= 1024.0 && name + 1 < NAMES.len() {
        value /= 1024.0;
        name += 1;
    }
    (value, NAMES[name])
}

/// A size for people, as text.
pub fn format_bytes(bytes: u64) -> String {
    match scaled_bytes(bytes as f64) {
        (value, "B") => format!("{value} B"),
        (value, unit) => format!("{value:.1} {unit}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_read() {
        for (text, bytes) in [
            ("2G", 2 << 30),
            ("512M", 512 << 20),
            ("1.5g", 3 << 29),
            ("64KiB", 64 << 10),
            ("10mb", 10 << 20),
            ("1T", 1 << 40),
            ("4096", 4096),
            ("4096B", 4096),
        ] {
            assert_eq!(parse_bytes(text), Ok(bytes), "{text}");
        }
    }

    #[test]
    fn nonsense_is_no_size() {
        for text in [
            "",
            "G",
            "two",
            "-1G",
            "1..5G",
            "1e3",
            "NaN",
            "inf",
            "0",
            "0.0001",
            "99999999T",
            "2 G G",
        ] {
            assert!(parse_bytes(text).is_err(), "{text}");
        }
    }

    #[test]
    fn counts_are_read() {
        for (text, count) in [
            ("1", 1),
            ("2000000", 2_000_000),
            ("20M", 20_000_000),
            ("1.5k", 1500),
            ("1G", 1_000_000_000),
        ] {
            assert_eq!(parse_count(text), Ok(count), "{text}");
        }
        for text in [
            "",
            "M",
            "0",
            "-5",
            "1.5",
            "0.0001k",
            "1e6",
            "20MB",
            "5T",
            "99999999G",
            "many",
        ] {
            let fault = parse_count(text).unwrap_err();
            assert!(fault.contains("such as 20M"), "{text}: {fault}");
        }
    }

    #[test]
    fn sizes_are_written_for_people() {
        assert_eq!(format_bytes(100), "100 B");
        assert_eq!(format_bytes(3 << 29), "1.5 GiB");
    }
}
